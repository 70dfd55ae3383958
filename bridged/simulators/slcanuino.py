"""An Arduino with kahiroka's slcanuino: on the bus from power-on, whatever C says.

It answers CR to every frame that it can read, sent or not; a remote frame must have 2 x DLC digits. When
the three buffers of its MCP2515 are full it waits for one of them, and reads nothing until then.

Decided here: it starts at 125 kbit/s; its UART keeps 64 characters while it waits, and loses the rest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final

from bridged.simulators import slcan
from bridged.simulators.slcan import BELL, CR, Slcan, State

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from bridged.simulators.sja1000 import Frame

TITLE = "Arduino with slcanuino"
ADAPTER: Final[Mapping[str, str | int]] = {}
FAULTS = slcan.FAULTS

UART_ROOM = 64


class Slcanuino(Slcan):
    name = "slcanuino"
    version, serial_number = b"V1234", b"N1234"
    longest = 32
    overflow = "BELL"
    transmit_room = 3
    remote_digits_received = True
    receive_room = 2 * 27
    rates: ClassVar[Mapping[bytes, float]] = slcan.rates_without(0, 1, 2, 7)

    def _boot(self) -> None:
        super()._boot()
        self.bitrate = 125_000.0
        self.state = State.OPEN
        self._stuck: Frame | None = None  # waits for one of the three buffers
        self._unread = bytearray()
        self._count = 0

    def power_off(self, now: float) -> None:
        super().power_off(now)
        self._stuck = None
        self._unread.clear()

    def _take(self, at: float, data: bytes) -> None:
        for place in range(len(data)):
            if self._stuck is not None:
                room = max(0, UART_ROOM - len(self._unread))
                self._unread += data[place : place + room]
                self.counters.bytes_lost += max(0, len(data) - place - room)
                return
            super()._take(at, data[place : place + 1])

    def was_sent(self, at: float, _frame: Frame) -> None:
        if self._stuck is None:
            return
        frame, self._stuck = self._stuck, None
        self.offer(at, frame)
        self._answer(at, CR)
        unread = bytes(self._unread)
        self._unread.clear()
        self._take(at, unread)

    def stamp(self, _at: float) -> str:
        """A counter that is no time."""
        self._count += 1
        return f"{self._count % 65536:04X}" if self.stamp_digits else ""

    def carry_out(self, at: float, letter: bytes, rest: bytes) -> bytes:
        if letter in b"tTrR":
            return self._frame(at, letter, rest)
        match letter:
            case b"V":
                return self.version + CR
            case b"N":
                return self.serial_number + CR
            case b"F":
                return b"F12\r"
            case b"S" if letter + rest in self.rates:
                self.bitrate = self.rates[letter + rest]
                return CR
            case b"C" | b"O" | b"M" | b"m":
                return CR
            case b"Z" if rest in (b"0", b"1"):
                self.stamp_digits = 4 * int(rest)
                return CR
            case b"Z" if rest == b"2":
                return BELL + CR
        return BELL

    def _frame(self, at: float, letter: bytes, rest: bytes) -> bytes:
        if not slcan.is_frame(letter, rest, remote_digits=True):
            self.counters.frames_vanished += 1
            return CR
        frame = slcan.frame_of(letter, rest)
        if len(self._buffer) >= self.transmit_room:
            self._stuck = frame
            return b""
        self.counters.frames_vanished += not self.offer(at, frame)
        return CR


def add_arguments(parser: argparse.ArgumentParser) -> None:
    slcan.add_arguments(parser, Slcanuino, uart=True)


def make_device(now: float, args: argparse.Namespace) -> Slcanuino:
    return slcan.make(Slcanuino, now, args, uart=True)
