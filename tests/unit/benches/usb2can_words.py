"""What the tests of the simulated USB2CAN share: messages in hex, the manual's initialisation, a host."""

from bridged.simulators.sja1000 import Frame, frame_bits
from bridged.simulators.usb2can import State, Usb2can

FRAME = Frame(0x123, False, False, 2, b"\x11\x33")
WRITTEN = bytes.fromhex("0F 40 05 02 24 60 11 33")  # FRAME from the host
RECEIVED = bytes.fromhex("0F 41 05 02 24 60 11 33")  # and to it
FRAME_S = frame_bits(FRAME) / 500_000
STOP = bytes.fromhex("0F 09 02 02 01")
GO = bytes.fromhex("0F 09 02 02 00")
VALUE_2 = bytes.fromhex("0F 09 02 02 02")
OVERRUN = bytes.fromhex("0F 09 01 03")

CONFIG, NORMAL, LOOPBACK, BOOT = "0F0200", "0F0300", "0F0400", "0F0100"
GET_MODE, GET, FW_VERSION, READ_RST = "0F0600", "0F200180", "0F2100", "0F6200"
READ_TEC, READ_REC = "0F6000", "0F6100"


def reg(address: int, value: int) -> str:
    return f"0F1202{address:02X}{value:02X}"


LIMITS = ("0F2002000F", "0F20020107")  # critical 15, ready 7
STEPS = {  # of chapter III
    2: (reg(0, 0x01),),
    3: (reg(31, 0xC0),),
    4: (*(reg(16 + n, 0x00) for n in range(4)), *(reg(20 + n, 0xFF) for n in range(4))),
    5: (reg(8, 0xDA),),
    6: (reg(4, 0x03),),
    7: (reg(6, 0x40), reg(7, 0x1C)),
    8: LIMITS,
}  # fmt: skip
STEPS_2_TO_8 = "".join(command for step in STEPS.values() for command in step)
SETUP = CONFIG + STEPS_2_TO_8
OPEN = SETUP + NORMAL + reg(0, 0x00)


def ask(device: Usb2can, commands: str, now: float = 0.0) -> bytes:
    """Write messages, given in hex, and read what comes back at once."""
    device.host_writes(now, bytes.fromhex(commands))
    return device.take_output(now)


def hexed(device: Usb2can, commands: str, now: float = 0.0) -> str:
    return ask(device, commands, now).hex().upper()


def opened(now: float = 0.0, mode: int = 0x00, **options: object) -> Usb2can:
    device = Usb2can(now, **options)  # type: ignore[arg-type]
    ask(device, SETUP + NORMAL + reg(0, mode), now)
    assert (device.state, device.violations) == (State.NORMAL, [])
    return device


def messages(output: bytes) -> list[tuple[int, bytes]]:
    """Command and data of each message; nothing may be in between."""
    found = []
    while output:
        assert output[0] == 0x0F
        end = 3 + output[2]
        assert len(output) >= end
        found.append((output[1], output[3:end]))
        output = output[end:]
    return found


def check_balance(device: Usb2can) -> None:
    counters = device.counters
    assert counters.frames_taken == counters.frames_sent + counters.frames_discarded + device.waiting
    assert device.waiting >= 0
