"""What the tests of the simulated clones share: a talk with one, as clones are known by what they answer."""

from collections.abc import Iterable

from bridged.simulators.sja1000 import Frame
from bridged.simulators.slcan import Slcan

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
