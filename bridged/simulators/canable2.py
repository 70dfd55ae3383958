"""A CANable 2 with canable2-fw: like canable-fw, with more room, FD frames, and other rates behind S7 and S9.

Decided here: 63 frames are on their way out at most; the ring of 2,048 bytes to the host loses what finds
no room.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final

from bridged.simulators import slcan
from bridged.simulators.canable1 import Canable1
from bridged.simulators.slcan import Slcan

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

TITLE = "CANable 2 with canable2-fw"
ADAPTER: Final[Mapping[str, str | int]] = {"type": "can232"}
FAULTS = slcan.FAULTS


class Canable2(Canable1):
    """See above. C empties everything; a frame that comes while the channel is closed is dropped."""

    name = "CANable 2"
    version = b"b158aa7 https://github.com/normaldotcom/canable2-fw.git"
    longest = 155
    transmit_room = 63
    close_empties = True
    receive_room = 2048
    mailboxes = 0
    letters = b"tTrRdDbB"
    takes_when_closed = False
    rates: ClassVar[Mapping[bytes, float]] = slcan.RATES | {b"S7": 170e6 / 7 / 17, b"S9": 83_300.0}

    def carry_out(self, at: float, letter: bytes, rest: bytes) -> bytes:
        if letter == b"X" and self.is_open:
            self.effects.append("frame of the bytes behind X")
        if letter == b"E":
            return b"0"
        return super().carry_out(at, letter, rest)

    def _receive(self, at: float, line: bytes) -> None:
        Slcan._receive(self, at, line)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    slcan.add_arguments(parser, Canable2)


def make_device(now: float, args: argparse.Namespace) -> Canable2:
    return slcan.make(Canable2, now, args)
