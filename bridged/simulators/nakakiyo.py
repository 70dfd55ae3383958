"""A CANable 2 with the firmware of Nakakiyo092 (VL2K…), or its sister for the USB2CANFDV1 (VW1K…).

VW1K takes any X, whatever follows, for the order to start its bootloader.

Decided here: the filter of M and m is like a CAN232's dual one; a frame that finds its 12,288 bytes for
the host full sets bit 3 of F (data overrun).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from bridged.simulators import slcan
from bridged.simulators.sja1000 import accepts
from bridged.simulators.slcan import BELL, CR, Strict

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from bridged.simulators.sja1000 import Frame

TITLE = "CANable 2 with Nakakiyo092's firmware"
ADAPTER: Final[Mapping[str, str | int]] = {"type": "can232"}
FAULTS = slcan.FAULTS


class Nakakiyo(Strict):
    name = "Nakakiyo"
    version = b"VL2K4"
    longest = 165
    letters = b"tTrRdDbB"
    transmit_room = 64
    receive_room = 3 * 4096

    def _boot(self) -> None:
        super()._boot()
        self._code, self._mask = bytes(4), b"\xff" * 4

    def lone_cr(self, _at: float) -> bytes:
        return CR

    def taken(self, letter: bytes) -> bytes:
        return slcan.z_or_z(letter)

    def passes(self, frame: Frame) -> bool:
        return self._mask == b"\xff" * 4 or accepts(self._code, self._mask, False, frame)

    def other(self, at: float, letter: bytes, rest: bytes) -> bytes:
        closed = not self.is_open
        match letter:
            case b"V" if not rest:
                return self.version + CR
            case b"v" if not rest:
                return b'v: hardware="CANable2.0", software="' + self.version[1:] + b'"\r'
            case b"N" if not rest and self.serial_number:
                return self.serial_number + CR
            case b"N" if len(rest) == 4:
                self.effects.append("flash written by N")
                return CR
            case b"X" if self.version.startswith(b"VW"):
                self.effects.append("bootloader")
                return b""
            case b"Q" if self.is_open and rest in (b"0", b"1", b"2"):
                self.effects.append("flash written by Q")
                return CR
            case b"F" if self.is_open and not rest:
                return self.flags()
            case b"C" if self.is_open and not rest:
                self.close_channel()
                return CR
            case b"O" | b"L" if closed and not rest and self.bitrate:
                self.open_channel(at, listen_only=letter == b"L")
                return CR
            case b"S" if closed and letter + rest in self.rates:
                self.bitrate = self.rates[letter + rest]
                return CR
            case b"s" if closed and len(rest) == 8:
                return CR
            case b"M" | b"m" if closed and len(rest) == 8 and slcan.HEX.issuperset(rest):
                value = bytes.fromhex(rest.decode())
                self._code, self._mask = (value, self._mask) if letter == b"M" else (self._code, value)
                return CR
            case b"Z" if closed and rest in (b"0", b"1", b"2"):
                self.stamp_digits = 4 * int(rest)
                return CR
            case b"W" if closed and rest == b"2":
                return CR
        return BELL


def add_arguments(parser: argparse.ArgumentParser) -> None:
    slcan.add_arguments(parser, Nakakiyo)


def make_device(now: float, args: argparse.Namespace) -> Nakakiyo:
    return slcan.make(Nakakiyo, now, args)
