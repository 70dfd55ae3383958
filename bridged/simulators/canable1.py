"""A CANable 1 with canable-fw: the firmware that CANable adapters are sold with; it answers nothing but V.

The command buffer is never cleared, and characters become values in place. So a lone CR carries out the
last command again, and a command with too few digits takes those that an earlier one left there.

Decided here: of the 30 frames on their way out three are in the controller's mailboxes, which C clears,
and 27 in a queue, which it does not; frames go in the order in which they came.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final

from bridged.simulators import slcan
from bridged.simulators.sja1000 import Frame
from bridged.simulators.slcan import CR, Slcan

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

TITLE = "CANable 1 with canable-fw"
ADAPTER: Final[Mapping[str, str | int]] = {}
FAULTS = slcan.FAULTS


class Canable1(Slcan):
    """See above. It has no listen-only mode: M1 sets it, and O sets the normal mode again."""

    name = "CANable 1"
    version = b"8ca5d39 https://github.com/normaldotcom/canable-fw.git"
    longest = 30
    transmit_room = 30
    close_empties = False
    remote_digits_received = True
    rates: ClassVar[Mapping[bytes, float]] = slcan.RATES | {b"S7": 750_000.0}
    mailboxes: ClassVar[int] = 3
    letters: ClassVar[bytes] = b"tTrR"
    takes_when_closed: ClassVar[bool] = True

    def _boot(self) -> None:
        super()._boot()
        self._characters = [0] * self.longest
        self._index = 0

    def _store(self, _at: float, byte: int) -> None:
        if self._index >= self.longest:
            self._index = 0
        self._characters[self._index] = byte
        self._index += 1

    def _end_line(self, at: float) -> None:
        characters = self._characters
        for place in range(1, self._index):
            byte = characters[place]
            base = 0x61 - 10 if byte >= 0x61 else 0x41 - 10 if byte >= 0x41 else 0x30
            characters[place] = byte - base & 0xFF
        self._index = 0
        letter = bytes((characters[0],))
        self.counters.commands[chr(characters[0])] += 1
        self._answer(at, self.carry_out(at, letter, b""))

    def carry_out(self, at: float, letter: bytes, rest: bytes) -> bytes:
        if letter == b"V":
            return self.version + CR
        if letter == b"O" and not self.is_open and self.bitrate:
            self.open_channel(at)
        elif letter == b"C":
            self.close_channel()
        elif letter == b"S" and not self.is_open:
            self.bitrate = self.rates.get(b"S%d" % self._characters[1], self.bitrate)
        elif letter in self.letters and letter:
            self._send(at, letter)
        return rest  # nothing

    def close_channel(self) -> None:
        super().close_channel()
        in_mailboxes = self._buffer[: self.mailboxes]
        del self._buffer[: self.mailboxes]
        self.counters.frames_discarded += len(in_mailboxes)

    def _send(self, at: float, letter: bytes) -> None:
        digits = slcan.ID_DIGITS[letter]
        values = self._characters
        can_id = 0
        for value in values[1 : digits + 1]:
            can_id = (can_id << 4) + value
        dlc = values[digits + 1]
        if dlc > (15 if letter in b"dDbB" else 8):
            return
        length = 0 if letter in b"rR" else slcan.FD_LENGTHS[dlc]
        nibbles = (values[digits + 2 :] + [0] * 128)[: 2 * length]
        pairs = zip(nibbles[::2], nibbles[1::2], strict=True)
        data = bytes((high << 4) + low & 0xFF for high, low in pairs)
        extended = digits == 8
        can_id &= 0x1FFFFFFF if extended else 0x7FF
        if letter in b"dDbB":
            if self.is_open:
                self.effects.append(f"FD frame {letter.decode()} {can_id:X} {data.hex().upper()}")
            return
        if self.is_open or self.takes_when_closed:
            frame = Frame(can_id, extended, letter in b"rR", dlc, data)
            self.counters.frames_vanished += not self.offer(at, frame)

    def _receive(self, at: float, line: bytes) -> None:
        """One packet at a time: what comes while the host has not taken the last one is lost."""
        if self._output:
            self.counters.frames_lost += 1
            return
        super()._receive(at, line)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    slcan.add_arguments(parser, Canable1)


def make_device(now: float, args: argparse.Namespace) -> Canable1:
    return slcan.make(Canable1, now, args)
