"""What the tests of the simulated CAN232 share: a host without a line between them."""

from bridged.simulators.can232 import Can232
from bridged.simulators.sja1000 import Frame

FRAME = Frame(0x100, False, False, 2, b"\x11\x33")


def ask(device: Can232, commands: str, now: float = 0.0) -> str:
    """Write commands and read what comes back, at once (the line has no rate)."""
    device.host_writes(now, commands.encode())
    return device.take_output(now).decode()


def opened(commands: str = "S6\rO\r", **options: object) -> Can232:
    device = Can232(**options)  # type: ignore[arg-type]
    answer = ask(device, commands)
    assert answer == "\r" * commands.count("\r")
    return device
