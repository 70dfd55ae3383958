"""An ESP32 with mintynet's esp32-slcan (TWAI): it answers CR to every frame, sent or lost.

A standard remote frame goes out as an extended one. Too few digits, and digits that are none, are taken.

Decided here: five frames wait at most (the driver's default); what finds no room for a moment is lost.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any, ClassVar, Final

from bridged.simulators import slcan
from bridged.simulators.sja1000 import Frame
from bridged.simulators.slcan import BELL, CR, Slcan, State

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

TITLE = "ESP32 with esp32-slcan"
ADAPTER: Final[Mapping[str, str | int]] = {}
FAULTS = slcan.FAULTS

DEAF_S = 1.0  # after power-on


class Esp32(Slcan):
    name = "ESP32"
    version, serial_number = b"V1234", b"N2233"
    longest = 32
    overflow = "BELL"
    transmit_room = 5
    remote_digits_received = True
    receive_room = 5 * 27
    rates: ClassVar[Mapping[bytes, float]] = slcan.rates_without(0, 1)

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._deaf_until = 0.0

    def power_on(self, now: float) -> None:
        super().power_on(now)
        self._deaf_until = now + DEAF_S

    def _hears(self, at: float) -> bool:
        return at >= self._deaf_until

    def carry_out(self, at: float, letter: bytes, rest: bytes) -> bytes:
        if letter in b"tTrR":
            self._frame(at, letter, rest)
            return CR
        match letter:
            case b"V":
                return self.version + CR
            case b"N":
                return self.serial_number + CR
            case b"F":
                return b"F00\r"
            case b"C":
                if not self.is_open:
                    return b""
                self.close_channel()
                return CR
            case b"O":
                if self.is_open:
                    return b""
                if not self.bitrate:
                    self.bitrate = 500_000.0
                self.open_channel(at)
                return CR
            case b"S" if letter + rest in self.rates:
                self.bitrate = self.rates[letter + rest]
                return CR
            case b"M" | b"m":
                return CR
            case b"Z" if rest in (b"0", b"1"):
                self.stamp_digits = 4 * int(rest)
                return CR
            case b"Z" if rest == b"2":
                return b""
        return BELL

    def _frame(self, at: float, letter: bytes, rest: bytes) -> None:
        if self.state is not State.OPEN:
            self.counters.frames_vanished += 1
            return
        digits = slcan.ID_DIGITS[letter]
        can_id, dlc = leading_hex(rest[:digits]), min(8, leading_hex(rest[digits : digits + 1]))
        remote = letter in b"rR"
        extended = letter in b"TRr"
        can_id &= 0x1FFFFFFF if extended else 0x7FF
        pairs = rest[digits + 1 : digits + 1 + 2 * dlc].ljust(2 * dlc, b"0")
        data = bytes(leading_hex(pairs[n : n + 2]) for n in range(0, 2 * dlc, 2))
        frame = Frame(can_id, extended, remote, dlc, b"" if remote else data)
        self.counters.frames_vanished += not self.offer(at, frame)


def leading_hex(text: bytes) -> int:
    """As strtoul: digits up to the first character that is none."""
    digits = bytes(itertools.takewhile(slcan.HEX.__contains__, text))
    return int(digits, 16) if digits else 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    slcan.add_arguments(parser, Esp32, uart=True)


def make_device(now: float, args: argparse.Namespace) -> Esp32:
    return slcan.make(Esp32, now, args, uart=True)
