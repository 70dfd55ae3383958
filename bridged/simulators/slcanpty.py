"""slcanpty of can-utils, another program at a pseudo terminal: no device, and no bit rate.

What follows the identifier of a remote frame is read as the next command.

Decided here: frames go to its CAN interface at once, at the rate of a bus of 1 Mbit/s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from bridged.simulators import slcan
from bridged.simulators.slcan import BELL, CR, Strict

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

TITLE = "slcanpty of can-utils"
ADAPTER: Final[Mapping[str, str | int]] = {"type": "can232", "firmware": "slcanpty"}
FAULTS = slcan.FAULTS


class Slcanpty(Strict):
    name = "slcanpty"
    version, serial_number = b"V1013", b"N4242"
    longest = 1000
    transmit_room = 1000
    receive_room = 1 << 20

    def _boot(self) -> None:
        super()._boot()
        self.bitrate = 1e6

    def carry_out(self, at: float, letter: bytes, rest: bytes) -> bytes:
        digits = slcan.ID_DIGITS.get(letter, 0)
        if letter in b"rR" and len(rest) > digits and slcan.HEX.issuperset(rest[:digits]):
            if self.is_open:
                self.offer(at, slcan.frame_of(letter, rest[:digits] + b"0"))
            return CR + BELL
        return super().carry_out(at, letter, rest)

    def other(self, at: float, letter: bytes, rest: bytes) -> bytes:
        match letter:
            case b"V":
                return self.version + CR
            case b"N":
                return self.serial_number + CR
            case b"F":
                return b"F00\r"
            case b"O":
                self.open_channel(at)
                return CR
            case b"C":
                self.close_channel()
                return CR
            case b"S" | b"M" | b"m":
                return CR
            case b"X" if rest == b"1":
                return CR
        return BELL


def add_arguments(parser: argparse.ArgumentParser) -> None:
    slcan.add_arguments(parser, Slcanpty)


def make_device(now: float, args: argparse.Namespace) -> Slcanpty:
    return slcan.make(Slcanpty, now, args)
