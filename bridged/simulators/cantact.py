"""A CANtact: no V, no answers, and a command line whose end nobody watches.

What is longer than its 30 characters, or comes in a packet of more than 32 bytes, overwrites memory; F
and K set its acceptance filter. A bridge must not send a byte of a flush to it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final

from bridged.simulators import slcan
from bridged.simulators.canable1 import Canable1

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

TITLE = "CANtact"
ADAPTER: Final[Mapping[str, str | int]] = {}
FAULTS = slcan.FAULTS


class Cantact(Canable1):
    name = "CANtact"
    version = b""
    packet_room: ClassVar[int] = 32

    def _take(self, at: float, data: bytes) -> None:
        if len(data) > self.packet_room:
            self.effects.append("memory overwritten by a packet")
        super()._take(at, data)

    def _store(self, at: float, byte: int) -> None:
        if self._index >= self.longest:
            self.effects.append("memory overwritten by a line")
        super()._store(at, byte)

    def carry_out(self, at: float, letter: bytes, rest: bytes) -> bytes:
        if letter in b"FK":
            self.effects.append("filter set")
        return b"" if letter == b"V" else super().carry_out(at, letter, rest)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    slcan.add_arguments(parser, Cantact)


def make_device(now: float, args: argparse.Namespace) -> Cantact:
    return slcan.make(Cantact, now, args)
