"""What a bad device does, kind by kind. Each is a course of steps with pauses, and a way to answer."""

import random
import termios
from collections.abc import Iterator
from typing import Protocol

from devices import Can232, Usb2can, message
from frames import make

LONGEST_PAUSE = 0.02  # of those that never cease
ALMOST_A_FRAME = (13, 15, 20, 25)  # bytes: of a USB2CAN without the last, of a CAN232 without the last digit
NEVER_SENT = 1 << 23  # number of a frame that was never sent


class World(Protocol):
    draw: random.Random
    device: Can232 | Usb2can
    deadline: float
    reading: bool
    holding: bool  # answers are kept back until it ends

    def put(self, data: bytes, after: float = 0.0) -> None:
        """The device says this, so much later."""

    def lie(self) -> None:
        """What it says from now on for a moment need not be true: a frame may be sent twice for it."""

    def fill(self, room: int) -> None:
        """Take no more than about so many bytes from the bridge before take_on()."""

    def hang_up(self) -> None: ...
    def plug_in(self) -> None: ...
    def flow(self, action: int) -> None: ...
    def traffic(self, count: int) -> None: ...
    def shout(self, data: bytes) -> None: ...


class Good:
    """Base: answers at once and truly."""

    honest = False  # what it says is true, if late, or not said at all

    def __init__(self, world: World) -> None:
        self.w = world
        self.draw = world.draw

    def steps(self) -> Iterator[float]:
        while True:
            yield 1.0

    def answer(self, data: bytes) -> None:
        self.w.put(data)

    def _now_and_then(self, longest: float = LONGEST_PAUSE) -> float:
        return self.draw.uniform(0, longest)

    def _untrue(self, data: bytes) -> bytes:
        """What may be taken for the refusal of a frame, or hide one."""
        self.w.lie()
        return data

    def _noise(self, longest: int) -> bytes:
        return self._untrue(self.draw.randbytes(self.draw.randrange(1, longest)))


class Garbage(Good):
    """Random bytes, more and more often."""

    def steps(self) -> Iterator[float]:
        while True:
            self.w.put(self._noise(300))
            yield self._now_and_then()


class NoisyAnswers(Good):
    """Bytes before, after and inside of answers."""

    def answer(self, data: bytes) -> None:
        if self.draw.random() < 0.3:
            at = self.draw.randrange(len(data) + 1)
            data = data[:at] + self._noise(4) + data[at:]
        self.w.put(data)


class HalfAnswers(Good):
    """The end of an answer is missing, or comes much later."""

    def answer(self, data: bytes) -> None:
        if self.draw.random() < 0.7:
            self.w.put(data)
            return
        at = self.draw.randrange(len(data))
        self.w.put(self._untrue(data[:at]))
        if self.draw.random() < 0.5:
            self.w.put(data[at:], after=self.draw.uniform(0, 0.5))


class LateAnswers(Good):
    """Some come late, in their order."""

    honest = True

    def answer(self, data: bytes) -> None:
        self.w.put(data, after=self.draw.choice((0, 0, 0, 0.01, 0.3, 1.0)))


class LostAnswers(Good):
    """Some never come."""

    honest = True

    def steps(self) -> Iterator[float]:
        while True:
            self._part = self.draw.choice((0.0, 0.02, 0.3))
            yield self._now_and_then(0.3)

    def answer(self, data: bytes) -> None:
        if self.draw.random() >= self._part:
            self.w.put(data)


class TwofoldAnswers(Good):
    """Two for one."""

    def answer(self, data: bytes) -> None:
        self.w.put(data)
        if self.draw.random() < 0.3:
            self.w.put(self._untrue(data))


class WrongAnswers(Good):
    """Another answer than the true one."""

    def steps(self) -> Iterator[float]:
        self._said = [b"\r", b"\a", b"z\r", b"Z\r", message(6, 1), message(9, 2, 1)]
        yield from super().steps()

    def answer(self, data: bytes) -> None:
        if self.draw.random() < 0.3:
            self._said = [*self._said[-20:], data]
            data = self._untrue(self.draw.choice(self._said))
        self.w.put(data)


class Storm(Good):
    """BELL, STOP and GO without end, for nothing."""

    def steps(self) -> Iterator[float]:
        words = (
            (b"\a", b"\a\a\a\r")
            if isinstance(self.w.device, Can232)
            else (message(9, 2, 1), message(9, 2, 0))
        )
        while True:
            self.w.put(self._untrue(self.draw.choice(words) * self.draw.randrange(1, 200)))
            yield self._now_and_then()


class Full(Good):
    """Takes frames now and then only, and says so truly; a USB2CAN though it should have room."""

    honest = True

    def steps(self) -> Iterator[float]:
        device = self.w.device
        try:
            while True:
                part = self.draw.choice((0.0, 0.05, 0.5, 1.0))
                device.refuses = lambda part=part: self.draw.random() < part  # type: ignore[misc]
                yield self._now_and_then(0.2)
        finally:
            device.refuses = lambda: False


class StopWithoutGo(Good):
    """No frame leaves it any more. A CAN232 takes none."""

    honest = True

    def steps(self) -> Iterator[float]:
        device = self.w.device
        try:
            if isinstance(device, Usb2can):
                device.full = True
            else:
                device.refuses = lambda: True
            yield from super().steps()
        finally:
            device.refuses = lambda: False
            if isinstance(device, Usb2can):
                device.full = False


class Strangers(Good):
    """Hands back frames that were never sent."""

    def steps(self) -> Iterator[float]:
        for number in range(NEVER_SENT, 2 * NEVER_SENT):
            self.w.put(self._untrue(self.w.device.handed_back(*make(number, number))))
            yield self._now_and_then()


class Flood(Good):
    """Frames as fast as the line takes them."""

    honest = True

    def steps(self) -> Iterator[float]:
        while True:
            self.w.traffic(200)
            yield 0.0


class Stall(Good):
    """Stops inside a message, and goes on: in time, or after the bridge has given the port up."""

    honest = True

    def steps(self) -> Iterator[float]:
        w = self.w
        try:
            while True:
                yield self._now_and_then()
                w.holding = True
                yield 0.003  # as many frames as the window has room for are on their way
                w.reading = False
                w.fill(room=self.draw.choice((*ALMOST_A_FRAME, self.draw.randrange(1, 48))))
                w.holding = False
                yield 0.002 + self._now_and_then()
                w.flow(termios.TCOOFF)
                w.reading = True
                yield self.draw.choice((0.0, 0.2, 0.9, 1.1, 2.0)) * w.deadline + 0.01
                w.flow(termios.TCOON)
        finally:
            w.holding = False
            w.reading = True
            w.flow(termios.TCOON)


class HangUp(Good):
    """The cable is pulled, and plugged in again."""

    honest = True

    def steps(self) -> Iterator[float]:
        try:
            while True:
                self.w.hang_up()
                yield self.draw.choice((0.0, 0.1, self.w.deadline + 0.3))
                self.w.device.reset()
                self.w.plug_in()
                yield self._now_and_then(0.5)
        finally:
            self.w.hang_up()
            self.w.device.reset()
            self.w.plug_in()


class Silence(Good):
    """Takes everything, says nothing."""

    honest = True

    def answer(self, data: bytes) -> None:
        pass


class Deaf(Good):
    """Takes nothing for a while."""

    honest = True

    def steps(self) -> Iterator[float]:
        try:
            while True:
                self.w.reading = False
                yield self.draw.choice((0.01, 0.5 * self.w.deadline, self.w.deadline + 0.3))
                self.w.reading = True
                yield self._now_and_then(0.1)
        finally:
            self.w.reading = True


class Shouts(Good):
    """Texts that nobody asked for, as fast as the line takes them."""

    def steps(self) -> Iterator[float]:
        texts = (
            (b"G0\r", b"V\r")
            if isinstance(self.w.device, Can232)
            else (message(16, 99, 1), message(98, 0, 1))
        )
        while True:
            self.w.shout(self._untrue(self.draw.choice(texts) * 500))
            yield 0.0


class EverNewReports(Good):
    """A thousand a second, of which no two are equal."""

    def steps(self) -> Iterator[float]:
        while True:
            for _ in range(10):
                a, b, c, rec, tec = self.draw.randbytes(5)
                if isinstance(self.w.device, Can232):
                    self.w.put(f"{self.draw.choice('FVNX')}{a:02X}{b:02X}{c:02X}\r".encode())
                elif a & 1:
                    self.w.put(message(8, a, b, c, rec, tec, a))
                else:
                    self.w.put(message(9, 1, a, b, c, rec, tec))
            yield 0.01

    def answer(self, data: bytes) -> None:
        flags = data[:1] == b"F" and isinstance(self.w.device, Can232)
        self.w.put(f"F{self.draw.randrange(256):02X}\r".encode() if flags else data)


class Resets(Good):
    """Loses its power for a moment, and is closed afterwards."""

    honest = True

    def steps(self) -> Iterator[float]:
        while True:
            self.w.device.reset()
            yield self._now_and_then(0.8)


class Closes(Good):
    """The channel is closed by itself."""

    honest = True

    def steps(self) -> Iterator[float]:
        while True:
            self.w.device.close()
            yield self._now_and_then(0.8)


KINDS: tuple[type[Good], ...] = (
    Garbage, NoisyAnswers, HalfAnswers, LateAnswers, LostAnswers, TwofoldAnswers, WrongAnswers, Storm, Full,
    StopWithoutGo, Strangers, Flood, Shouts, Stall, HangUp, Silence, Deaf, EverNewReports, Resets, Closes,
)  # fmt: skip
