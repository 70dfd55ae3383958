"""A USBtin 1.4: an MCP2515 whose three transmit buffers do not keep the order, and a line whose head stays.

Whatever follows the digits of a complete command is ignored, so nothing can keep a command that lacks
only its CR from being carried out.

Decided here: a frame goes into the first of the three buffers that is free, and the last one that is
taken is sent first (MCP2515 data sheet, 3.1: of equal priority, the highest buffer number); C leaves the
buffers as they are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from bridged.simulators import slcan
from bridged.simulators.slcan import BELL, CR, Slcan, State

LF = 10

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from bridged.simulators.sja1000 import Frame

TITLE = "USBtin 1.4"
ADAPTER: Final[Mapping[str, str | int]] = {}
FAULTS = slcan.FAULTS

USB_ROOM = 128


class Usbtin(Slcan):
    name = "USBtin"
    version, serial_number = b"V0100", b"NFFFF"
    longest = 100
    overflow = "last byte"
    transmit_room = 3
    close_empties = False

    def _boot(self) -> None:
        super()._boot()
        self._places: list[int] = []  # which of its three buffers each frame of _buffer is in

    def _put(self, frame: Frame) -> None:
        self._places.append(min({0, 1, 2, *range(3, self.transmit_room)} - {*self._places}))
        super()._put(frame)

    def _pick(self) -> int:
        return self._places.index(max(self._places))

    def was_sent(self, _at: float, _frame: Frame) -> None:
        del self._places[self._picked]

    def _finish(self) -> None:
        assert self._sending is not None
        self._picked = self._sending
        super()._finish()

    def _empty_buffer(self) -> None:
        super()._empty_buffer()
        self._places = []

    def _store(self, at: float, byte: int) -> None:
        if byte != LF:
            super()._store(at, byte)

    def _receive(self, at: float, line: bytes) -> None:
        room = USB_ROOM - len(self._output)
        if len(line) <= room:
            super()._receive(at, line)
            return
        self.counters.frames_lost += 1
        self.counters.bytes_lost += len(line) - room
        self._say(at, line[:room])

    def flags(self) -> bytes:
        flags = super().flags()
        return flags if self.bus_off else b"F%02X\r" % (int(flags[1:3], 16) & 0x7F)

    def carry_out(self, at: float, letter: bytes, rest: bytes) -> bytes:
        closed = not self.is_open
        if letter in b"tTrR":
            for end in range(len(rest) + 1):
                if slcan.is_frame(letter, rest[:end]) and self.state is State.OPEN:
                    frame = slcan.frame_of(letter, rest[:end])
                    return slcan.z_or_z(letter) if self.offer(at, frame) else BELL
            return BELL
        match letter:
            case b"V":
                return self.version + CR
            case b"v":
                return b"v0104\r"
            case b"N":
                return self.serial_number + CR
            case b"F":
                return self.flags()
            case b"W" if len(rest) >= 4 and slcan.HEX.issuperset(rest[:4]):
                self.effects.append("register written")
                return CR
            case b"C" if not closed:
                self.close_channel()
                return CR
            case b"O" | b"L" if closed and self.bitrate:
                self.open_channel(at, listen_only=letter == b"L")
                return CR
            case b"S" if closed and letter + rest[:1] in self.rates:
                self.bitrate = self.rates[letter + rest[:1]]
                return CR
            case b"s" if closed and len(rest) >= 6:
                return CR
            case b"M" | b"m" if closed:
                return CR
            case b"Z" if rest:
                self.stamp_digits = 0 if rest[:1] == b"0" else 4
                return CR
        return BELL


def add_arguments(parser: argparse.ArgumentParser) -> None:
    slcan.add_arguments(parser, Usbtin)


def make_device(now: float, args: argparse.Namespace) -> Usbtin:
    return slcan.make(Usbtin, now, args)
