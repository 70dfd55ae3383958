"""An 8N1 line as a model: when each character is there, by a clock that is passed in.

A simulator in real time is always a little late: the answer whose last character is on the line at `t` gets
to the host at `t + late`. The host, which cannot know, reacts at `t + late + reaction`. Were that taken as it
is, the line would stand idle for `late` in each exchange, a real line would not, and a test of how well
a host uses the line would measure the simulator. But `late` is known. So what the host writes after a late
delivery is put on the line `late` earlier than it was seen, that is at `t + reaction`: the time line of the
wire does not contain the simulator's delays. Limits keep it causal: nothing starts before the line is free,
nor before the last delivery was due, and no command is complete before an instant that the device has already
lived through. A simulator that is later than a command takes on the line can therefore not be made up for:
that time is in `stalled_s`, and a line was used to `busy_s / (elapsed - stalled_s)`.

A simulator that wakes late also finds several things to have happened; it lives through them in their order
at their own times (see `Can232.advance`), so that only what the host sees is late.
"""

from __future__ import annotations

import math
from collections import deque

CHARACTER_BITS = 10  # start bit, eight data bits, stop bit
END_OF_LINE = 13


class Uart:
    """Both directions of one line; all times in seconds of the caller's clock, none is read here.

    `baud` in bit/s; None is a line without a rate, where everything arrives at once.
    """

    def __init__(self, baud: int | None = None) -> None:
        self.baud = baud
        self.host_chars = 0  # from the host, arrived
        self.host_busy_s = 0.0
        self.device_chars = 0  # from the device, put on the line
        self.device_busy_s = 0.0
        self.late_s = 0.0  # of the last delivery to the host
        self.late_max_s = 0.0
        self.stalled_s = 0.0  # idle time of the line from the host that is the simulator's fault
        self._bursts: deque[tuple[float, bytearray]] = deque()  # (start, characters) without a pause
        self._host_free = 0.0
        self._cut = 0  # length of the first piece
        self.arrival = math.inf  # when the next end of a line, or of a burst without one, is at the device
        self.delivery = math.inf  # when the next message is at the host
        self._messages: deque[tuple[float, bytes]] = deque()  # (end, characters)
        self._device_free = 0.0
        self._delivered = 0.0

    @property
    def baud(self) -> int | None:
        """Rate in bit/s; a new one holds for what is put on the line from now on."""
        return self._baud

    @baud.setter
    def baud(self, baud: int | None) -> None:
        self._baud = baud
        self.char_s = CHARACTER_BITS / baud if baud else 0.0

    @property
    def host_backlog(self) -> int:
        """Characters that the host has written and that have not yet arrived."""
        return sum(len(data) for _, data in self._bursts) if self._bursts else 0

    @property
    def device_backlog(self) -> int:
        """Characters that the device has said and that the host has not got."""
        return sum(len(data) for _, data in self._messages)

    def host_writes(self, at: float, data: bytes, device_clock: float) -> None:
        """Queue what the host wrote, seen at `at`; `device_clock` is what the device has lived through."""
        if not data:
            return
        if self._bursts and at - self.late_s <= self._host_free:
            start, burst = self._bursts[-1]
            burst += data
        else:
            end = data.find(END_OF_LINE) + 1 or len(data)
            free = max(at - self.late_s, self._delivered, self._host_free)
            start = max(free, device_clock - end * self.char_s)
            self.stalled_s += start - free
            self._bursts.append((start, bytearray(data)))
            self._host_free = start
        self._host_free += len(data) * self.char_s
        self._plan()

    def take_arrived(self) -> tuple[float, bytes]:
        """When the first character of the piece due at `arrival` was there, and the piece."""
        start, burst = self._bursts[0]
        cut = self._cut
        piece = bytes(burst[:cut])
        if cut == len(burst):
            self._bursts.popleft()
        else:
            del burst[:cut]
            self._bursts[0] = (start + cut * self.char_s, burst)
        self.host_chars += cut
        self.host_busy_s += cut * self.char_s
        self._plan()
        return start + self.char_s, piece

    def transmit(self, at: float, data: bytes) -> float:
        """Put a message on the line, after what is on it; returns when its last character is out."""
        busy = len(data) * self.char_s
        self._device_free = end = max(at, self._device_free) + busy
        if not self._messages:
            self.delivery = end
        self._messages.append((end, data))
        self.device_chars += len(data)
        self.device_busy_s += busy
        return end

    def deliver(self, now: float) -> bytes:
        """All messages whose last character is on the line by `now`; then call `delivered`."""
        messages = self._messages
        chunks = []
        while messages and messages[0][0] <= now:
            self._delivered, data = messages.popleft()
            chunks.append(data)
        self.delivery = messages[0][0] if messages else math.inf
        return b"".join(chunks)

    def delivered(self, at: float) -> None:
        """The last `deliver` reached the host at `at`: how late that was counts for its reaction."""
        if self._baud:
            self.late_s = at - self._delivered
            self.late_max_s = max(self.late_max_s, self.late_s)

    def cut_off(self, now: float) -> None:
        """The device lost power at `now`: a message that was not finished is gone."""
        while self._messages and self._messages[-1][0] > now:
            self._messages.pop()
        if not self._messages:
            self.delivery = math.inf
        self._device_free = now

    def _plan(self) -> None:
        if self._bursts:
            start, burst = self._bursts[0]
            self._cut = burst.find(END_OF_LINE) + 1 or len(burst)
            self.arrival = start + self._cut * self.char_s
        else:
            self.arrival = math.inf
