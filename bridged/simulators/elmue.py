"""A CANable 2.5 with the firmware of Elmue: C is never answered and forgets the bit rate, F lists filters.

A frame with too few digits is taken. After half a second without an acknowledgement everything that waits is
thrown away, though it was answered CR.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar, Final

from bridged.simulators import slcan
from bridged.simulators.slcan import BELL, CR, Slcan, State

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

TITLE = "CANable with Elmue's firmware 2.5"
ADAPTER: Final[Mapping[str, str | int]] = {"type": "can232"}
FAULTS = slcan.FAULTS

GIVES_UP_S = 0.5


class Elmue(Slcan):
    name = "Elmue"
    version = (
        b"+Board: MksMakerbase\tMCU: STM32G431\tDevID: 1128\tFirmware: 2508001\tSlcan: 100\tClock: 160\t"
        b"Limits: 512,256,128,128,32,32,16,16\tFeatures: 1023\tFilters: 8\tTimings: 4\t"
        b"Serial: 207A32585541500E"
    )
    longest = 165
    transmit_room = 64
    receive_room = 3 * 4096
    rates: ClassVar[Mapping[bytes, float]] = slcan.RATES | {
        b"S9": 83_300.0, b"SA": 75_000.0, b"SB": 62_500.0, b"SC": 33_300.0, b"SD": 5_000.0,
    }  # fmt: skip

    def _boot(self) -> None:
        super()._boot()
        self._silent_mode = False
        self._gives_up_at = math.inf

    def lone_cr(self, _at: float) -> bytes:
        return CR

    def close_channel(self) -> None:
        super().close_channel()
        self.bitrate = 0.0
        self._silent_mode = False

    def _resume(self, at: float) -> None:
        super()._resume(at)
        waits = bool(self._buffer) and self._done_at == math.inf and self.sends()
        self._gives_up_at = min(self._gives_up_at, at + GIVES_UP_S) if waits else math.inf

    def timer(self) -> float:
        return self._gives_up_at

    def on_timer(self, _now: float) -> None:
        self._empty_buffer()

    def _empty_buffer(self) -> None:
        super()._empty_buffer()
        self._gives_up_at = math.inf

    def carry_out(self, at: float, letter: bytes, rest: bytes) -> bytes:
        closed = not self.is_open
        if letter in b"tTrR":
            return self._frame(at, letter, rest)
        match letter:
            case b"V" if not rest:
                return self.version + CR
            case b"C" if not rest:
                self.close_channel()
                return b""
            case b"O" if rest in (b"", b"S") and closed and self.bitrate:
                self.open_channel(at, listen_only=self._silent_mode or rest == b"S")
                return CR
            case b"F" if not rest:
                return CR
            case b"S" if closed and letter + rest in self.rates:
                self.bitrate = self.rates[letter + rest]
                return CR
            case b"A" if closed and rest in (b"0", b"1"):
                return CR
            case b"M" if closed and rest in (b"0", b"1"):
                self._silent_mode = rest == b"1"
                return CR
            case b"M" if closed and rest == b"00000000":
                self._silent_mode = False
                return CR
            case b"M" if rest == b"F":
                return b"#0\r"
            case b"*":
                self.effects.append("flash written, or bootloader")
                return CR
        return BELL

    def _frame(self, at: float, letter: bytes, rest: bytes) -> bytes:
        digits = slcan.ID_DIGITS[letter]
        dlc = rest[digits : digits + 1]
        if self.state is not State.OPEN or not slcan.HEX.issuperset(rest) or (dlc and int(dlc, 16) > 8):
            return BELL
        length = digits + 1 + (2 * int(dlc or b"0") if letter in b"tT" else 0)
        if len(rest) > length:
            return BELL
        whole = (rest + b"0" * length)[:length]  # the rest is whatever its stack holds
        if int(whole[:digits], 16) > (0x7FF if digits == 3 else 0x1FFFFFFF):
            return BELL
        return CR if self.offer(at, slcan.frame_of(letter, whole)) else BELL


def add_arguments(parser: argparse.ArgumentParser) -> None:
    slcan.add_arguments(parser, Elmue)


def make_device(now: float, args: argparse.Namespace) -> Elmue:
    return slcan.make(Elmue, now, args)
