"""A device with catompiler's slcan slave library: whatever is malformed has no answer at all.

After one listen-only channel it stays silent for good, C and O notwithstanding. Its FIFO of 32 frames
outlives C.

Decided here: a new S, or power-off, does not end that silence but for power-off.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from bridged.simulators import slcan
from bridged.simulators.slcan import BELL, CR, Strict

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

TITLE = "slave library of catompiler"
ADAPTER: Final[Mapping[str, str | int]] = {"type": "can232"}
FAULTS = slcan.FAULTS


class Catompiler(Strict):
    name = "catompiler"
    version, serial_number = b"V0103", b"N1234"
    longest = 32
    overflow = "lost"
    malformed = b""
    transmit_room = 32
    close_empties = False
    receive_room = 32 * 27

    def _boot(self) -> None:
        super()._boot()
        self.auto_poll = False
        self._silent_for_good = False

    def sends(self) -> bool:
        return super().sends() and not self._silent_for_good

    def too_long(self) -> bytes:
        return b""

    def lone_cr(self, _at: float) -> bytes:
        return BELL

    def taken(self, letter: bytes) -> bytes:
        return slcan.z_or_z(letter) if self.auto_poll else CR

    def other(self, at: float, letter: bytes, rest: bytes) -> bytes:
        closed = not self.is_open
        match letter:
            case b"V" | b"N" | b"F" | b"C" | b"O" | b"L" | b"A" | b"P" if rest:
                return b""
            case b"V":
                return self.version + CR
            case b"N":
                return self.serial_number + CR
            case b"F" if not closed:
                return self.flags()
            case b"A" if not closed and not self.auto_poll:
                return b"A\r"
            case b"C" if not closed:
                self.close_channel()
                return CR
            case b"O" | b"L" if closed and self.bitrate:
                self._silent_for_good |= letter == b"L"
                self.open_channel(at, listen_only=letter == b"L")
                return CR
            case b"S" if closed:
                if letter + rest not in self.rates:
                    return b""
                self.bitrate = self.rates[letter + rest]
                return CR
            case b"s" | b"M" | b"m" if closed:
                return CR
            case b"X" if closed and rest in (b"0", b"1"):
                self.auto_poll = rest == b"1"
                return CR
            case b"Z" if closed:
                if rest not in (b"0", b"1"):
                    return b""
                self.stamp_digits = 4 * int(rest)
                return CR
            case b"U" if closed:
                self.effects.append("UART rate changed")
                return CR
        return BELL


def add_arguments(parser: argparse.ArgumentParser) -> None:
    slcan.add_arguments(parser, Catompiler, uart=True)


def make_device(now: float, args: argparse.Namespace) -> Catompiler:
    return slcan.make(Catompiler, now, args, uart=True)
