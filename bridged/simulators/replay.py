"""Any adapter, as far as a capture of `can-bridge run --capture` tells: it says what it said then.

How a capture is read is told in replay_script.py. Of what the device said there
- answers to questions come when their questions come, the first to the first, so long after it as then; the
  last one again when the host asks more often than in the capture;
- what followed a command or frame at once comes when the host has said as many of both as then, commands and
  frames counted apart, and so long after the last of them as then;
- anything else comes when the host has said as much as then, and at its time: that of the capture, and later
  by as much as the host is with its commands.

A command is told by its first letter or number: what it sets may be another today. Some may be missing today.
One that is not in the capture at that place gets what the last of its kind got. A frame is waited for as long
as `--patience` says: perhaps nobody sends one today. There is no CAN bus: only a host makes it speak.
"""

from __future__ import annotations

import enum
import logging
import math
from collections import deque
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final

from bridged.simulators.options import positive
from bridged.simulators.replay_script import read

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from bridged.simulators.device import OwnFault
    from bridged.simulators.replay_script import Piece, Script
    from bridged.simulators.sja1000 import Frame

TITLE: Final = "any adapter, from the capture of what it said to a bridge"
ADAPTER: Final[Mapping[str, str | int]] = {}  # the file tells
FAULTS: Final[Mapping[str, OwnFault]] = {}

PATIENCE_S = 1.0
REPEATED = 16  # a command that is among so many before may be missing now,
NEAR = 2  # and so many others at once

log = logging.getLogger(__name__)


class State(enum.Enum):
    """Of the play."""

    BEFORE = "before"  # the host has said nothing
    PLAYING = "playing"
    ENDED = "ended"  # all is said


@dataclass
class Counters:
    """Of frames, those that every device has: what it gets is not sent, for it has no bus."""

    frames_taken: int = 0
    frames_sent: int = 0
    frames_discarded: int = 0
    frames_received: int = 0
    frames_lost: int = 0
    frames_filtered: int = 0
    frames_unseen: int = 0
    frames_missing: int = 0  # that the device has waited for in vain
    commands: int = 0
    commands_missing: int = 0  # of the capture, not said now
    commands_unknown: int = 0  # said now, not in the capture at that place


class Play:
    """Where in the script the two are, and when the device says what."""

    def __init__(self, script: Script, patience_s: float, counters: Counters) -> None:
        self._script = script
        self._patience_s = patience_s
        self._counters = counters
        self._lag_s = math.inf  # of the host behind the capture; it has not begun
        self._commands = 0  # of the script, said or missing; so
        self._frames = 0
        self._is_patient = True
        self._answers: deque[tuple[float, bytes]] = (
            deque()
        )  # when it says what, in the order of what they answer

    @property
    def state(self) -> State:
        if self._lag_s == math.inf:
            return State.BEFORE
        over = not (self._script.pieces or self._script.replies or self._answers)
        return State.ENDED if over else State.PLAYING

    def hear(self, now: float, data: bytes) -> None:
        """The host says something, if not yet a whole command."""
        if self._lag_s == math.inf and data:
            self._lag_s = now - self._script.begins_at

    def command(self, now: float, kind: bytes) -> None:
        self._counters.commands += 1
        commands, answers = self._script.commands, self._script.answers.get(kind)
        is_next = self._commands < len(commands) and commands[self._commands].kind == kind
        if answers and not is_next:
            answer = answers.popleft() if len(answers) > 1 else answers[0]
            self._answer(now + answer.after_s, answer.data)
            return
        place = self._place(kind)
        if place is None:
            self._counters.commands_unknown += 1
            if self._counters.commands_unknown == 1:
                log.warning("the host says %r, which it did not say here in the capture", kind)
            for answer in self._script.usual.get(kind, ()):
                self._answer(now + answer.after_s, answer.data)
            return
        self._counters.commands_missing += place - self._commands
        self._commands = place + 1
        self._lag_s = max(self._lag_s, now - commands[place].at)
        self._release(now)

    def frame(self, now: float) -> None:
        self._frames += 1
        self._is_patient = True
        self._release(now)

    def next_at(self) -> float:
        """When advance() has something to do if the host says nothing."""
        ours = (self._due(pieces) for pieces in (self._script.pieces, self._script.replies))
        return min(*ours, self._answers[0][0] if self._answers else math.inf)

    def advance(self, now: float) -> bytes:
        """What the device has said by then."""
        said = bytearray()
        while (at := self.next_at()) <= now:
            if self._answers and self._answers[0][0] == at:
                said += self._answers.popleft()[1]
                continue
            pieces = self._script.pieces if self._due(self._script.pieces) == at else self._script.replies
            piece = pieces.popleft()
            self._give_up(piece.frames - self._frames)
            said += piece.data
        return bytes(said)

    def _place(self, kind: bytes) -> int | None:
        """Of this command in the script: the next, but for some that were repeated and now are not."""
        commands = self._script.commands
        repeated = {command.kind for command in commands[max(0, self._commands - REPEATED) : self._commands]}
        for place in range(self._commands, min(len(commands), self._commands + REPEATED)):
            if commands[place].kind == kind:
                return place
            if commands[place].kind not in repeated and place - self._commands >= NEAR:
                break
        return None

    def _release(self, now: float) -> None:
        """What follows at once what the host has said now."""
        replies = self._script.replies
        while replies and self._said_before(replies[0]):
            reply = replies.popleft()
            self._answer(now + reply.after_s, reply.data)

    def _said_before(self, piece: Piece) -> bool:
        return piece.commands <= self._commands and piece.frames <= self._frames

    def _answer(self, at: float, data: bytes) -> None:
        """In its turn: a device answers one after the other."""
        self._answers.append((max(at, self._answers[-1][0]) if self._answers else at, data))

    def _due(self, pieces: deque[Piece]) -> float:
        """When the first is said."""
        if not pieces or pieces[0].commands > self._commands:
            return math.inf
        waits = self._is_patient and pieces[0].frames > self._frames
        return pieces[0].at + self._lag_s + (self._patience_s if waits else 0.0)

    def _give_up(self, missing: int) -> None:
        """Frames that were to come before what is said now."""
        if missing > 0:
            if self._counters.frames_missing == 0:
                log.warning("the host sends no frame where it did in the capture: it is not waited for")
            self._counters.frames_missing += missing
            self._frames += missing
            self._is_patient = False


class Replay:
    """The device; times in seconds of the caller's clock.

    What befalls it, but for power and noise, is not in the capture and does nothing.
    """

    own_faults: ClassVar[Mapping[str, OwnFault]] = FAULTS

    def __init__(self, script: Script, title: str, patience_s: float = PATIENCE_S) -> None:
        self.title = title
        self.counters = Counters()
        self.silent = False
        self.refusals = 0
        self.drop_answers = 0
        self._play = Play(script, patience_s, self.counters)
        self._protocol = script.protocol
        self._begun = b""  # by the host
        self._powered = True
        self._output = bytearray()

    @property
    def state(self) -> State:
        return self._play.state

    def power_on(self, _now: float) -> None:
        self._powered = True

    def power_off(self, _now: float) -> None:
        self._powered = False
        self._output.clear()

    def power_cycle(self, _now: float) -> None:
        self._output.clear()

    def set_bus_off(self, now: float, bus_off: bool) -> None:
        pass

    def set_listen_only(self, now: float, listen_only: bool) -> None:
        pass

    def set_error_counters(self, now: float, tec: int, rec: int) -> None:
        pass

    def garbage(self, now: float, noise: bytes) -> None:
        self.advance(now)
        self._say(noise)

    def host_writes(self, now: float, data: bytes) -> None:
        self.advance(now)
        if not self._powered:
            return
        self._play.hear(now, data)
        units, self._begun = self._protocol.cut(self._begun + data)
        for unit in units:
            if self._protocol.is_frame(unit):
                self.counters.frames_taken += 1
                self.counters.frames_discarded += 1
                self._play.frame(now)
            else:
                self._play.command(now, self._protocol.kind(unit))

    def take_output(self, now: float) -> bytes:
        self.advance(now)
        output = bytes(self._output)
        self._output.clear()
        return output

    def bus_frame(self, _now: float, _frame: Frame) -> None:
        self.counters.frames_unseen += 1

    def take_bus_frames(self) -> list[Frame]:
        return []

    def advance(self, now: float) -> None:
        self._say(self._play.advance(now))

    def next_deadline(self) -> float:
        return self._play.next_at()

    def report(self) -> dict[str, object]:
        return {"state": self.state.value, "counters": asdict(self.counters)}

    def _say(self, data: bytes) -> None:
        if self._powered and not self.silent:
            self._output += data


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="a capture of can-bridge run --capture FILE")
    parser.add_argument(
        "--patience",
        type=positive,
        default=PATIENCE_S,
        metavar="SECONDS",
        help=f"how long to wait for a frame that the host sent in the capture; default: {PATIENCE_S:g}",
    )


def make_device(_now: float, args: argparse.Namespace) -> Replay:
    return Replay(read(args.file), f"replay of {args.file.name}", args.patience)
