"""A device that answers no frame, behind a link of uneven delay, on a bus with others; one clock."""

from __future__ import annotations

import random
from collections import deque
from typing import Any

from benches.relay import EFF_FLAG, FRAME, Rig
from bridged.adapters.base import Confirms, Sending
from bridged.bridge.loop import set_sending

RTR_FLAG = 0x40000000
CRC_POLYNOMIAL = 0b1100010110011001
S = 1_000_000_000


def bits_of(frame: bytes) -> int:
    """How many bits a frame takes on the bus, with the pause behind it: written out, then stuffed."""
    can_id, length, data = FRAME.unpack(frame)
    remote = "1" if can_id & RTR_FLAG else "0"
    if can_id & EFF_FLAG:
        wide = f"{can_id & 0x1FFFFFFF:029b}"
        sent = f"0{wide[:11]}11{wide[11:]}{remote}00"
    else:
        sent = f"0{can_id & 0x7FF:011b}{remote}00"
    sent += f"{length:04b}"
    if remote == "0":
        sent += "".join(f"{byte:08b}" for byte in data[:length])
    left = int(sent, 2) << 15  # the CRC is what a division by the polynomial leaves
    for place in range(left.bit_length() - 1, 14, -1):
        if left >> place & 1:
            left ^= CRC_POLYNOMIAL << (place - 15)
    sent += f"{left:015b}"
    stuffed = ""
    for bit in sent:
        stuffed += bit
        if len(stuffed) >= 5 and len(set(stuffed[-5:])) == 1:
            stuffed += "0" if bit == "1" else "1"
    return len(stuffed) + 1 + 2 + 7 + 3


class Silent(Rig):
    """A device with room for `room` frames loses what does not fit, without a word.

    `slow`: by how much its bus is slower than by the host's clock. `link_ns`: the longest delay to it.
    """

    def __init__(
        self, *, bitrate: int, room: int, depth: int, slow: float = 0.0, link_ns: int = 0, seed: int = 0
    ) -> None:
        super().__init__(queue=4096, deadline=60.0)
        self.bit_ns = S / bitrate * (1 + slow)
        self.room, self.link_ns = room, link_ns
        self.random = random.Random(seed)
        self.under_way: deque[tuple[int, bytes]] = deque()  # when it reaches the device
        self.up: deque[tuple[int, bytes]] = deque()  # when an answer reaches the host
        self.waiting: deque[bytes] = deque()
        self.sent: list[bytes] = []
        self.lost = 0
        self.busy_ns = 0.0  # when the bus is free again
        self.stalls: list[tuple[int, int]] = []  # from, to: nothing reaches the device
        self.others: deque[tuple[int, bytes]] = deque()  # when they would like to send
        set_sending(self.relay, Sending(Confirms.NOTHING, paced_bitrate=bitrate, depth=depth))

    def run(self, until: int) -> None:
        """What happens until then, each at its time."""
        due = self.turn_and_link()
        while True:
            times = [until] if due is None else [until, due]
            if self.up:
                times.append(self.up[0][0])
            if self.under_way:
                times.append(self.under_way[0][0])
            if self.waiting:
                times.append(int(self.busy_ns) + 1)
            if self.others:
                times.append(max(self.others[0][0], int(self.busy_ns) + 1))
            at = max(self.now, min(times))
            self.now = at
            if at >= until:
                return
            self._device()
            due = self.turn_and_link()

    def turn_and_link(self) -> int | None:
        due = self.turn()
        for line in self.said():
            self._link(line)
        return due

    def _link(self, line: bytes) -> None:
        arrives = self.now + self.random.randint(0, self.link_ns)
        arrives = max([arrives, *(end for begin, end in self.stalls if begin <= arrives < end)])
        if self.under_way:
            arrives = max(arrives, self.under_way[-1][0])
        self.under_way.append((arrives, line))

    def _device(self) -> None:
        while self.up and self.up[0][0] <= self.now:
            self.port.send(self.up.popleft()[1])
        while self.under_way and self.under_way[0][0] <= self.now:
            _, line = self.under_way.popleft()
            if len(self.waiting) == self.room:
                self.lost += 1
                self._answer(b"\a")
            else:
                self.waiting.append(line)
                self._answer(b"Z\r" if line[:1] in b"TR" else b"z\r")
        while self.busy_ns <= self.now and (self.waiting or self._other_is_due()):
            if self._other_is_due():  # of a higher priority
                frame = self.others.popleft()[1]
                self.port.send(b"t%03X8%s\r" % (FRAME.unpack(frame)[0], frame[8:].hex().upper().encode()))
            else:
                frame = frame_of(self.waiting.popleft())
                self.sent.append(frame)
            self.busy_ns = self.now + bits_of(frame) * self.bit_ns

    def _answer(self, answer: bytes) -> None:
        """It says nothing."""

    def _other_is_due(self) -> bool:
        return bool(self.others) and self.others[0][0] <= self.now


class Queued(Silent):
    """The same, but it answers a frame when it is in its buffer, or has no room there."""

    def __init__(self, *, sending: Sending, **options: Any) -> None:
        super().__init__(depth=1, **options)
        set_sending(self.relay, sending)

    def _answer(self, answer: bytes) -> None:
        self.up.append((self.now + self.link_ns, answer))

    def _link(self, line: bytes) -> None:
        if line == b"V":  # is the refusal one?
            self._answer(b"V1013\r")
        else:
            super()._link(line)


def frame_of(line: bytes) -> bytes:
    extended = line[:1] in b"TR"
    head = 10 if extended else 5
    flags = EFF_FLAG * extended | RTR_FLAG * (line[:1] in b"rR")
    return FRAME.pack(
        int(line[1 : head - 1], 16) | flags,
        int(line[head - 1 : head], 16),
        bytes.fromhex(line[head:].decode()),
    )
