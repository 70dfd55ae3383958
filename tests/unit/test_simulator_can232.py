"""The simulated CAN232 against its manual: commands, states, buffers, EEPROM, filters, faults."""

import dataclasses
import itertools
import math
import random

import pytest
from benches.can232_words import FRAME, ask, opened
from hypothesis import example, given
from hypothesis import strategies as st

from bridged.simulators.can232 import RECEIVE_FIFO, TRANSMIT_FIFO, Can232, State
from bridged.simulators.can232_memory import Eeprom
from bridged.simulators.sja1000 import Frame, accepts, bitrate, frame_bits
from bridged.simulators.uart import Uart

CHAR_S = 10 / 115_200


def receive(device: Can232, *frames: Frame, now: float = 0.0) -> str:
    for frame in frames:
        device.bus_frame(now, frame)
    return device.take_output(now).decode()


# Commands and states


def test_the_manuals_first_session():
    device = Can232()
    assert ask(device, "\r\r\rV\rS4\rO\rt1001AA\r") == "\r\r\rV1324\r\r\r\r"
    device.advance(0.01)
    assert device.take_bus_frames() == [Frame(0x100, False, False, 1, b"\xaa")]
    assert device.bitrate == 125_000


IN_STATE = {
    State.UNINITIATED: "",
    State.CLOSED: "S6\r",
    State.OPEN: "S6\rO\r",
    State.LISTEN_ONLY: "S6\rL\r",
}
UCO = "UNINITIATED CLOSED"
ALWAYS = "UNINITIATED CLOSED OPEN LISTEN_ONLY"


@pytest.mark.parametrize(
    ("command", "states", "answer"),
    [
        ("S4", UCO, "\r"),
        ("s031C", UCO, "\r"),
        ("O", "CLOSED", "\r"),
        ("L", "CLOSED", "\r"),
        ("C", "OPEN LISTEN_ONLY", "\r"),
        ("t10021133", "OPEN", "\r"),
        ("t0200", "OPEN", "\r"),
        ("t7FF80011223344556677", "OPEN", "\r"),
        ("T0000010021133", "OPEN", "\r"),
        ("T1FFFFFFF0", "OPEN", "\r"),
        ("T1FFFFFFF80011223344556677", "OPEN", "\r"),
        ("r1002", "OPEN", "\r"),
        ("R000001002", "OPEN", "\r"),
        ("P", "OPEN LISTEN_ONLY", "\r"),
        ("A", "OPEN LISTEN_ONLY", "A\r"),
        ("F", "OPEN LISTEN_ONLY", "F00\r"),
        ("X0", UCO, "\r"),
        ("X1", UCO, "\r"),
        ("Z1", UCO, "\r"),
        ("U1", UCO, "\r"),
        ("W1", "CLOSED", "\r"),
        ("M00006000", "CLOSED", "\r"),
        ("m00001FF0", "CLOSED", "\r"),
        ("Q1", "OPEN LISTEN_ONLY", "\r"),
        ("V", ALWAYS, "V1324\r"),
        ("N", ALWAYS, "NA123\r"),
        ("", ALWAYS, "\r"),
    ],
)
def test_each_command_works_in_its_states_only(command: str, states: str, answer: str):
    for state, preparation in IN_STATE.items():
        device = opened(preparation)
        assert device.state is state
        expected = answer if state.name in states.split() else "\a"
        assert ask(device, command + "\r") == expected, state
        assert device.counters.refused == (expected == "\a")
        assert device.counters.rs232_lost == 0


@pytest.mark.parametrize(
    "line",
    [
        "t1002113", "t100211", "t1002113344", "t10021G33", "t1009112233445566778899", "t8000", "t10", "t",
        "T000001002113", "T200000000", "T100", "r10021133", "r8000", "R0000010", "R1000",
        "t100 ", " t1000", "t1000\n", "tabc0", "t+100", "V1", "F0", "O1", "C1", "x", "b", "\x00", "\xff",
        "P1", "A1", "t" * 60,
    ],
)  # fmt: skip
def test_what_is_not_exactly_a_command_is_refused_and_sends_nothing(line: str):
    device = opened()
    device.host_writes(0, line.encode("latin-1") + b"\r")
    assert device.take_output(1) == b"\a"  # with no CR after it
    device.advance(2)
    assert device.take_bus_frames() == []
    assert ask(device, "V\r", 2) == "V1324\r"


@pytest.mark.parametrize(
    "line", ["S9", "S", "S10", "s031", "s03GG", "s031c", "X2", "Z2", "W2", "U7", "M0000600", "m1"]
)
def test_bad_settings_are_refused(line: str):
    device = opened("S6\r")
    assert ask(device, line + "\r") == "\a"
    assert device.eeprom == Eeprom()
    assert device.bitrate == 500_000


def test_bit_rates():
    expected = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000]
    for number, rate in enumerate(expected):
        assert opened(f"S{number}\r").bitrate == rate
    assert opened("s031C\r").bitrate == bitrate(0x03, 0x1C) == 125_000
    assert opened("s0014\r").bitrate == 1_000_000


def test_bit_rate_and_filter_survive_closing():
    device = opened("S4\rM00006000\rm00001FF0\rO\rC\r")
    assert device.state is State.CLOSED
    assert ask(device, "L\r") == "\r"
    assert (device.bitrate, device.code.hex(), device.mask.hex()) == (125_000, "00006000", "00001ff0")


def test_auto_poll_changes_the_answers_and_ends_polling():
    device = opened("X1\rS6\rO\r")
    assert ask(device, "t1000\rT000001000\rr1000\rR000001000\r") == "z\rZ\rz\rZ\r"
    assert ask(device, "P\rA\r") == "\a\a"
    assert receive(device, FRAME) == "t10021133\r"


def test_polling():
    device = opened()
    assert receive(device, FRAME, dataclasses.replace(FRAME, extended=True)) == ""
    assert receive(device, Frame(0x7FF, False, True, 3, b"")) == ""
    assert ask(device, "P\r") == "t10021133\r"
    assert ask(device, "A\r") == "T0000010021133\rr7FF3\rA\r"
    assert ask(device, "P\rA\r") == "\rA\r"


def test_a_half_typed_command_waits_for_its_end():
    device = opened()
    assert ask(device, "t100") == ""
    assert ask(device, "\r\r\r") == "\a\r\r"
    assert ask(device, "V") + ask(device, "\r") == "V1324\r"


def test_old_firmware_has_no_auto_poll():
    device = Can232(version="V1013", serial_number="0042", eeprom=Eeprom(auto_poll=True, time_stamps=True))
    assert ask(device, "V\rN\rS4\rX1\rX0\rW0\rZ0\rO\rQ1\rt1000\r") == "V1013\rN0042\r\r\a\a\a\a\r\a\r"
    assert receive(device, FRAME) == ""
    assert ask(device, "A\r") == "t10021133\rA\r"
    assert device.eeprom.writes == 0


def test_time_stamps_run_from_0_to_59999():
    device = Can232(now=100.0)
    ask(device, "X1\rZ1\rS8\rO\r", 100.0)
    times = [100.0, 100.019815, 159.9991, 160.0, 160.0011, 280.5]
    stamps = [receive(device, FRAME, now=now)[-5:-1] for now in times]
    assert stamps == ["0000", "0013", "EA5F", "0000", "0001", "01F4"]


# Buffers


def test_transmit_fifo_holds_8_and_drains_at_the_bit_rate():
    device = opened("S4\rO\r")
    assert ask(device, "t10081122334455667788\r" * 10) == "\r" * TRANSMIT_FIFO + "\a" * 2
    assert ask(device, "F\rF\r") == "F02\rF00\r"
    duration_s = frame_bits(Frame(0x100, False, False, 8, bytes(8))) / 125_000
    assert 111 / 125_000 <= duration_s <= 135 / 125_000
    device.advance(0.999 * duration_s)
    assert device.take_bus_frames() == []
    assert device.next_deadline() == pytest.approx(duration_s)
    device.advance(3.5 * duration_s)
    assert len(device.take_bus_frames()) == 3
    assert ask(device, "t1000\r" * 4, 3.5 * duration_s) == "\r" * 3 + "\a"
    device.advance(1)
    frames = device.take_bus_frames()
    assert [len(frame.data) for frame in frames] == [8] * 5 + [0] * 3
    assert (device.counters.frames_sent, device.counters.refused_full) == (11, 3)


def test_receive_fifo_holds_32_and_tells_what_it_lost():
    device = opened()
    frames = [Frame(number, False, False, 0, b"") for number in range(RECEIVE_FIFO + 3)]
    receive(device, *frames)
    assert ask(device, "F\rF\r") == "F01\rF00\r"
    assert ask(device, "A\r").count("\r") == RECEIVE_FIFO + 1
    assert (device.counters.frames_received, device.counters.frames_lost) == (RECEIVE_FIFO, 3)


def test_nothing_is_received_while_closed_and_closing_drops_what_is_queued():
    device = Can232()
    for commands in ("", "S4\r", "O\r"):
        ask(device, commands)
        receive(device, FRAME)
    assert (device.counters.frames_unseen, device.counters.frames_received) == (2, 1)
    assert ask(device, "t1000\rt1000\rC\rO\rP\r") == "\r" * 5
    device.advance(1)
    counters = device.counters
    assert (counters.frames_taken, counters.frames_sent, counters.frames_discarded) == (2, 0, 2)


@pytest.mark.parametrize(("unanswered", "lost"), [(1, 0), (2, 0), (3, 1), (5, 3)])
def test_a_host_that_does_not_wait_overruns_the_rs232_buffer(unanswered: int, lost: int):
    device = opened()
    device.processing_s = 0.005
    command = b"t1001AA\r"
    device.host_writes(0, command * unanswered)
    assert device.take_output(1) == b"\r" * (unanswered - lost)
    assert device.counters.rs232_lost == lost * len(command)
    assert device.counters.frames_taken == unanswered - lost


def test_received_frames_on_the_line_hold_up_commands():
    """The main loop sends one message after the other; meanwhile two short commands fit, not three."""
    device = Can232(uart=Uart(115_200), eeprom=Eeprom(auto_poll=True))
    device.host_writes(0, b"S8\rO\r")
    device.take_output(1)
    device.bus_frame(1, Frame(0x1FFFFFFF, True, False, 8, bytes(8)))
    assert device.next_deadline() == 1
    device.bus_frame(1, FRAME)
    device.host_writes(1, b"t1000\r" * 4)
    assert device.take_output(2) == b"T1FFFFFFF80000000000000000\r" + b"z\r" * 2 + b"t10021133\r"
    assert device.counters.rs232_lost == 12
    assert device.counters.frames_taken == 2


def test_the_line_carries_523_frames_a_second_to_the_host():
    device = Can232(uart=Uart(115_200), eeprom=Eeprom(auto_poll=True))
    device.host_writes(0, b"S8\rO\r")
    device.take_output(1)
    for number in range(600):
        device.bus_frame(1 + number / 600, Frame(number, False, False, 8, bytes(8)))
    arrived = device.take_output(2).count(b"\r")
    assert arrived in {522, 523}
    counters = device.counters
    assert counters.frames_received + counters.frames_lost == 600
    assert counters.frames_received - arrived in {RECEIVE_FIFO, RECEIVE_FIFO + 1}  # and one is on the line


def test_a_deadline_is_never_missed_and_never_without_effect():
    """Waking at next_deadline only gives the same as looking all the time."""
    outputs = []
    for step in (None, CHAR_S / 3):
        device = Can232(uart=Uart(115_200), eeprom=Eeprom(auto_poll=True), processing_s=0.0001)
        device.host_writes(0, b"S4\rO\rF\r")
        device.advance(0.01)
        device.host_writes(0.01, b"t1008" + b"11" * 8 + b"\rT000000000\rgarbage\r")
        device.bus_frame(0.011, FRAME)
        now, output, wakes = 0.01, b"", 0
        while (deadline := device.next_deadline()) < math.inf:
            assert wakes < 5000
            now = max(now, deadline) if step is None else now + step
            output += device.take_output(now)
            wakes += 1
        outputs.append((output, device.take_bus_frames()))
    assert outputs[0] == outputs[1]
    assert outputs[0][0] == b"\r\rF00\rt10021133\rz\rZ\r\a"
    assert len(outputs[0][1]) == 2


# EEPROM


def test_settings_survive_power_off_and_every_write_counts():
    device = opened("S4\rX1\rX1\rZ1\rW1\rU1\rO\rQ0\r")
    assert device.eeprom.writes == 6
    device.power_cycle(1)
    assert device.state is State.UNINITIATED
    assert (device.code, device.mask) == (bytes(4), b"\xff" * 4)
    eeprom = device.eeprom
    assert (eeprom.auto_poll, eeprom.time_stamps, eeprom.single_filter, eeprom.uart) == (True, True, True, 1)
    assert ask(device, "S4\rM00006000\rO\rC\rX2\rV\r", 1) == "\r\r\r\r\aV1324\r"
    assert eeprom.writes == 6


def test_u_changes_the_rate_after_its_answer_and_for_ever():
    device = Can232(uart=Uart(9600))
    assert device.eeprom.uart == 5
    device.host_writes(0, b"U1\r")
    assert device.take_output(3.9 * 10 / 9600) == b""
    assert device.take_output(4.1 * 10 / 9600) == b"\r"  # three characters in and one out, at the old rate
    device.host_writes(1, b"N\r")
    assert device.take_output(1 + 8.1 * 10 / 115_200) == b"NA123\r"
    device.power_cycle(2)
    assert (device.uart.baud, device.eeprom.uart, device.eeprom.writes) == (115_200, 1, 1)


@pytest.mark.parametrize(("number", "state"), [(1, State.OPEN), (2, State.LISTEN_ONLY)])
def test_auto_start_opens_with_its_bit_rate_and_filter(number: int, state: State):
    eeprom = opened(f"S4\rM00006000\rm00001FF0\rO\rQ{number}\r").eeprom
    assert eeprom.writes == 1
    device = Can232(5.0, eeprom=eeprom)
    assert device.state is state
    assert receive(device, Frame(0x355, False, False, 0, b""), FRAME, now=5.0) == "t3550\r"  # unasked
    expected = "z\r" if state is State.OPEN else "\a"
    assert ask(device, "t1000\rP\r", 5.0) == expected + "\a"
    device.advance(6.0)
    assert ask(device, "C\rO\rt1000\r", 6.0) == "\r\r\r"  # X0 counts again
    assert ask(device, "Q0\r", 6.0) == "\r"
    device.power_cycle(7.0)
    assert device.state is State.UNINITIATED


# Acceptance filter

ID11 = [f"id{bit}" for bit in range(10, -1, -1)]
ID29 = [f"id{bit}" for bit in range(28, -1, -1)]
DATA1 = [f"a{bit}" for bit in range(7, -1, -1)]
DATA2 = [f"b{bit}" for bit in range(7, -1, -1)]
UNUSED = [""]
LAYOUTS = {  # SJA1000 data sheet: what is compared with bits 7..0 of registers 0..3; (single, extended)
    (True, False): [[*ID11, "rtr", *UNUSED * 4, *DATA1, *DATA2]],
    (True, True): [[*ID29, "rtr", *UNUSED * 2]],
    (False, False): [
        [*ID11, "rtr", *DATA1[:4], *UNUSED * 12, *DATA1[4:]],
        [*UNUSED * 16, *ID11, "rtr", *UNUSED * 4],
    ],
    (False, True): [[*ID29[:16], *UNUSED * 16], [*UNUSED * 16, *ID29[:16]]],
}


def frame_bit_values(frame: Frame) -> dict[str, int]:
    """The bits of a frame that a filter can see, by name."""
    bits = {f"id{n}": frame.can_id >> n & 1 for n in range(29 if frame.extended else 11)}
    bits["rtr"] = int(frame.remote)
    for letter, byte in zip("ab", frame.data, strict=False):
        bits |= {f"{letter}{n}": byte >> n & 1 for n in range(8)}
    return bits


def accepts_bit_by_bit(code: bytes, mask: bytes, single: bool, frame: Frame) -> bool:
    bits = frame_bit_values(frame)

    def fits(layout: list[str]) -> bool:
        for place, name in enumerate(layout):
            register, position = place // 8, 7 - place % 8
            care = not mask[register] >> position & 1
            if care and name in bits and bits[name] != code[register] >> position & 1:
                return False
        return True

    return any(fits(layout) for layout in LAYOUTS[single, frame.extended])


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    extended, remote, dlc = draw(st.booleans()), draw(st.booleans()), draw(st.integers(0, 8))
    can_id = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    return Frame(
        can_id, extended, remote, dlc, b"" if remote else draw(st.binary(min_size=dlc, max_size=dlc))
    )


registers = st.binary(min_size=4, max_size=4)
masks = registers | st.lists(st.sampled_from([0xFF, 0xF0, 0x0F, 0xFE, 0]), min_size=4, max_size=4).map(bytes)


@given(code=registers, mask=masks, single=st.booleans(), frame=frames())
def test_filter_agrees_with_the_data_sheet(code: bytes, mask: bytes, single: bool, frame: Frame):
    assert accepts(code, mask, single, frame) == accepts_bit_by_bit(code, mask, single, frame)


@given(single=st.booleans(), second=st.booleans(), frame=frames())
@example(single=True, second=False, frame=Frame(0x123, False, False, 1, b"\x55"))
def test_each_bit_of_the_code_counts_as_the_data_sheet_says(single: bool, second: bool, frame: Frame):
    """A code that fits the frame in one filter and contradicts it in the other, then each bit changed."""
    layouts = LAYOUTS[single, frame.extended]
    chosen = layouts[-1] if second else layouts[0]
    values = frame_bit_values(frame)
    pattern = 0
    for place in range(32):
        for layout in layouts:
            value = values.get(layout[place], 0) ^ (layout is not chosen and layout[place] in values)
            pattern |= value << 31 - place
    for changed in (0, *(1 << bit for bit in range(32))):
        code = (pattern ^ changed).to_bytes(4)
        accepted = accepts(code, bytes(4), single, frame)
        assert accepted == accepts_bit_by_bit(code, bytes(4), single, frame)
        assert accepted or changed


def test_the_manuals_filter_passes_300_to_3ff():
    device = opened("S4\rM00006000\rm00001FF0\rO\r")
    for can_id in range(1, 0x800):
        receive(device, Frame(can_id, False, False, 0, b""))
        assert ask(device, "P\r") == (f"t{can_id:03X}0\r" if 0x300 <= can_id <= 0x3FF else "\r")
    assert receive(device, Frame(0x300, False, True, 1, b"")) == ""
    assert ask(device, "P\r") == "r3001\r"
    assert device.counters.frames_filtered == 0x7FF - 0x100
    assert ask(device, "C\rm00001FE0\rO\r") == "\r\r\r"
    receive(device, Frame(0x300, False, True, 1, b""), Frame(0x300, False, False, 0, b""))
    assert ask(device, "A\r") == "t3000\rA\r"  # 0xE0 instead of 0xF0: no remote frames


# Faults


def test_bus_off_fills_the_fifo_and_shows_in_the_flags():
    device = opened()
    device.set_bus_off(0, True)
    assert ask(device, "t1000\r" * 9) == "\r" * 8 + "\a"
    device.advance(100)
    assert device.take_bus_frames() == []
    assert ask(device, "F\rF\r", 100) == "FA6\rFA4\r"
    device.set_bus_off(100, False)
    device.advance(101)
    assert len(device.take_bus_frames()) == 8
    assert ask(device, "F\r", 101) == "F00\r"


def test_refusals_drops_and_silence():
    device = opened()
    device.refusals = 2
    assert ask(device, "t1000\rV\rt1000\rt1000\r") == "\aV1324\r\a\r"
    device.drop_answers = 2
    assert ask(device, "t1000\rN\rt1000\r") == "\r"
    assert device.counters.answers_dropped == 2
    assert device.counters.frames_taken == 3  # carried out, but the host was not told
    device.silent = True
    assert ask(device, "t1000\rV\r") == ""
    device.silent = False
    assert ask(device, "V\r") == "V1324\r"
    assert device.counters.frames_taken == 4


def test_reset_behind_the_hosts_back():
    device = opened("X1\rS4\rO\r")
    ask(device, "t1000\r")
    device.host_writes(0, b"t10")
    device.power_cycle(0)
    assert ask(device, "V\rt1000\r") == "V1324\r\a"
    assert receive(device, FRAME) == ""
    assert ask(device, "V\rO\rS4\rO\rt1000\r") == "V1324\r\a\r\rz\r"
    assert device.counters.frames_discarded == 1


def test_without_power_nothing_goes_in_or_out():
    device = Can232(uart=Uart(115_200), eeprom=Eeprom(auto_poll=True))
    device.host_writes(0, b"S4\rO\r")
    device.take_output(1)
    device.bus_frame(1, FRAME)
    device.host_writes(1, b"N\r")
    device.power_off(1 + 5 * CHAR_S)  # in the middle of the message, before the command's turn
    device.host_writes(1.5, b"V\r")
    device.bus_frame(1.5, FRAME)
    assert device.take_output(2) == b""
    assert device.next_deadline() == math.inf
    assert device.counters.rs232_lost == 0
    device.power_on(2)
    device.host_writes(2, b"V\r")
    assert device.take_output(3) == b"V1324\r"


def test_garbage_comes_between_messages():
    device = opened("X1\rS6\rO\r")
    noise = random.Random(1).randbytes(5)
    device.garbage(0, noise)
    device.bus_frame(0, FRAME)
    assert device.take_output(0) == noise + b"t10021133\r"


@given(data=st.binary(max_size=200), cuts=st.lists(st.integers(0, 200), max_size=5))
def test_however_the_bytes_are_cut_the_device_does_the_same(data: bytes, cuts: list[int]):
    whole, pieces = opened(), opened()
    places = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    whole.host_writes(0, data)
    for begin, end in itertools.pairwise(places):
        pieces.host_writes(0, data[begin:end])
        pieces.advance(0)
    assert whole.take_output(9) == pieces.take_output(9)
    assert whole.take_bus_frames() == pieces.take_bus_frames()
    assert whole.counters == pieces.counters
