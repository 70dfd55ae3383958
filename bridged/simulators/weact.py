"""A WeAct USB2CANFDV1: it answers a frame when that has been on the bus, which no other one does.

Decided here: frames are sent in the order in which they came; 16 wait at most, and while they do every
command is answered BELL; without A1 a frame that nobody acknowledges is tried once, and then answered
BELL.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar, Final

from bridged.simulators import slcan
from bridged.simulators.slcan import BELL, CR, Strict

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from bridged.simulators.sja1000 import Frame

TITLE = "WeAct USB2CANFDV1"
ADAPTER: Final[Mapping[str, str | int]] = {"type": "can232"}
FAULTS = slcan.FAULTS

ONE_SHOT_S = 0.001  # what one try of a frame without acknowledgement takes
THROWN_AWAY_S = 0.1  # output that the host does not take is thrown away


class Weact(Strict):
    """Half a command is forgotten after 10 ms; a lone CR is the first character of the next command."""

    name = "WeAct"
    version = b"WeAct Studio V1.0.0.8_20250401"
    longest = 139
    overflow = "last byte"
    forgets_after_s = 0.010
    letters = b"tTrRdDbB"
    transmit_room = 16
    receive_room = 16 * 32
    rates: ClassVar[Mapping[bytes, float]] = slcan.RATES | {
        b"S9": 83_300.0, b"SA": 75_000.0, b"SB": 62_500.0, b"SC": 33_300.0, b"SD": 5_000.0,
    }  # fmt: skip

    def _boot(self) -> None:
        super()._boot()
        self.retransmits = False
        self._silent_mode = False
        self._tried_by = math.inf

    def _end_line(self, at: float) -> None:
        if self._line:
            super()._end_line(at)
        else:
            self._line += CR

    def _execute(self, at: float, line: bytes) -> bytes:
        if len(self._buffer) >= self.transmit_room:
            self.counters.refused_full += 1
            return BELL
        return super()._execute(at, line)

    def taken(self, _letter: bytes) -> bytes:
        return b""  # it answers when the frame has been on the bus

    def was_sent(self, at: float, _frame: Frame) -> None:
        self._answer(at, CR)

    def _resume(self, at: float) -> None:
        super()._resume(at)
        waits = bool(self._buffer) and self._done_at == math.inf and not self.retransmits and self.sends()
        self._tried_by = at + ONE_SHOT_S if waits else math.inf

    def timer(self) -> float:
        return self._tried_by

    def on_timer(self, now: float) -> None:
        self._buffer.pop(0)
        self._sending = None
        self.counters.frames_discarded += 1
        self._answer(now, BELL)
        self._resume(now)

    def _empty_buffer(self) -> None:
        super()._empty_buffer()
        self._tried_by = math.inf

    def _say(self, at: float, text: bytes) -> None:
        if self._output and at - self._oldest_output > THROWN_AWAY_S:
            self.counters.bytes_lost += len(self._output)
            self._output.clear()
        super()._say(at, text)

    def other(self, at: float, letter: bytes, rest: bytes) -> bytes:
        closed = not self.is_open
        match letter:
            case b"V" if not rest:
                return self.version + CR
            case b"X" if not rest and closed:
                self.effects.append("bootloader")
                return b""
            case b"C" if not rest:
                self.close_channel()
                return CR
            case b"O" if not rest:
                if self.bitrate:
                    self.open_channel(at, listen_only=self._silent_mode)
                return CR
            case b"S" if letter + rest in self.rates:
                if closed:
                    self.bitrate = self.rates[letter + rest]
                return CR
            case b"S" if len(rest) in (4, 6):
                return CR
            case b"A" if closed and rest in (b"0", b"1"):
                self.retransmits = rest == b"1"
                return CR
            case b"M" if closed and rest in (b"0", b"1"):
                self._silent_mode = rest == b"1"
                return CR
            case b"H" if rest == b"1":
                self.effects.append("binary mode")
                return CR
            case b"E" if not rest:
                return b"0"
        return BELL


def add_arguments(parser: argparse.ArgumentParser) -> None:
    slcan.add_arguments(parser, Weact)


def make_device(now: float, args: argparse.Namespace) -> Weact:
    return slcan.make(Weact, now, args)
