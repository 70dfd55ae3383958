"""The simulated clones: talked to by the tests of each, and made for a Host that drives them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from bridged.simulators import SIMULATORS, make_device
from bridged.simulators.sja1000 import Frame
from bridged.simulators.slcan import Slcan

CAN232 = "can232"
DEAF = {"usb2can", "cantact"}  # another protocol; answers nothing
FAMILIES = tuple(sorted(SIMULATORS.keys() - DEAF - {CAN232, "replay"}))
OF_ANOTHER_FAMILY = {"nakakiyo-fd": ("nakakiyo", "VW1K2")}
FRAME = Frame(0x123, False, False, 2, b"\xaa\xbb")
REMOTE = Frame(0x123, False, True, 2, b"")


class Talk:
    """`says` sends bytes to the device and returns what it answers; `now` is the clock of both."""

    def __init__(self, device: Slcan, *, setup: Iterable[bytes] = ()) -> None:
        self.device = device
        self.now = 0.0
        for line in setup:
            self.says(line)

    def says(self, sent: bytes, *, waits_s: float = 0.05) -> bytes:
        self.device.host_writes(self.now, sent)
        self.now += waits_s
        return self.device.take_output(self.now)

    def on_bus(self, *, after_s: float = 0.1) -> list[Frame]:
        """What the device has put on the bus since the last look."""
        self.now += after_s
        self.device.advance(self.now)
        return self.device.take_bus_frames()

    def hears(self, frame: Frame) -> bytes:
        """What the device says of a frame on the bus."""
        self.device.bus_frame(self.now, frame)
        return self.device.take_output(self.now)

    def books(self) -> None:
        """No frame that it took is nowhere."""
        counters, waiting = self.device.counters, self.device.report()["buffered"]
        assert counters.frames_taken == counters.frames_sent + counters.frames_discarded + waiting  # type: ignore[operator]


def clone(name: str, *, is_open: bool = False) -> Any:
    """A device, switched on at 0; `is_open`: at 125 kbit/s, as another program has left it."""
    family, version = OF_ANOTHER_FAMILY.get(name, (name, None))
    device: Any = make_device(family, ["--version", version] if version else [], now=0.0)
    if not is_open:
        return device
    if family == CAN232:
        device.host_writes(0.0, b"S4\rO\r")
        device.advance(0.0)
        device.take_output(0.0)
    else:
        device.bitrate = 125_000.0
        device.open_channel(0.0)
    return device


def effects(device: Any) -> list[str]:
    """What nobody can take back: frames that it took to send, register and flash writes, a bootloader.

    A frame counts also if the device was closed before it could be on the bus: a real one is quicker.
    """
    counters = device.counters
    frames = counters.frames_taken + getattr(counters, "frames_vanished", 0)
    return [*getattr(device, "effects", ()), *["frame"] * frames]
