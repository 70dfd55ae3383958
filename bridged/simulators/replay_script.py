r"""A capture of `can-bridge run --capture`, taken apart for replay.py.

    # can-bridge-capture version=0.1.0 type=can232 bitrate=125000 …
    # 0.012345 opened
    0.012811 > V\r
    0.014902 < V1013\r

`<` is the device, `>` its host; seconds; bytes as Python escapes them.

What the device said is one of three:
- a text, as `V1013` or `F00`: the answer to a question, the last one that begins alike and has no answer, or
  the last command at all;
- an acknowledgement or the like, not later than ANSWER_S after its host has said something;
- anything else, above all frames: said by itself.
"""

from __future__ import annotations

import re
from collections import defaultdict, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

from bridged.errors import PortError
from bridged.simulators.usb2can_messages import (
    BITMOD_READ_REG,
    ERROR,
    LENGTH_MAX,
    READ_MESSAGE,
    READ_MESSAGE_TS,
    START,
    WRITE_MESSAGE,
    WRITE_REG,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

ANSWER_S: Final = 0.1
QUESTION_S: Final = 1.0  # after so long a text is no answer any more

_HEAD = "# can-bridge-capture "
_PIECE = re.compile(r"(\d+\.\d+) ([<>]) ((?:[!-\[\]-~]|\\[\\rnt]|\\x[0-9a-f]{2})*)")
_ESCAPE = re.compile(r"\\(x..|.)")
_CHARACTERS = {"\\": "\\", "r": "\r", "n": "\n", "t": "\t"}
_FRAMES = (WRITE_MESSAGE, READ_MESSAGE, READ_MESSAGE_TS)
_EMPTY = b"\r\a zZ"  # a line of nothing else is no text


class Protocol(NamedTuple):
    """How both speak."""

    size: Callable[[bytes], int]  # of the first unit: a line, a message; 0: its end is missing
    is_frame: Callable[[bytes], bool]
    is_text: Callable[[bytes], bool]  # of the device
    kind: Callable[[bytes], bytes]  # of a command; the same for those that set the same
    is_answer: Callable[[bytes, bytes], bool]  # whether a text begins as its question, of that kind
    tells_kind: bool  # each answer begins so

    def cut(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Units, and the beginning of the next."""
        units = []
        while size := self.size(data):
            units.append(data[:size])
            data = data[size:]
        return units, data


def _line_size(data: bytes) -> int:
    end = re.search(rb"[\r\a]", data)
    return end.end() if end else 0


def _line_kind(line: bytes) -> bytes:
    """The first letter, twice if the line begins so: VVVV… empties buffers and asks nothing."""
    return line[: 2 if line[1:2] == line[:1] else 1]


def _message_size(data: bytes) -> int:
    if data and data[0] != START:
        return 1
    if len(data) < 3:
        return 0
    size = 3 + data[2] if data[2] <= LENGTH_MAX else 1
    return size if len(data) >= size else 0


def _is_answer(message: bytes, kind: bytes) -> bool:
    has_register = WRITE_REG - 2 <= message[1] <= BITMOD_READ_REG
    return message[:2] + message[3:4] == kind if has_register else message[:2] == kind[:2]


PROTOCOLS: Final = {
    "can232": Protocol(
        size=_line_size,
        is_frame=lambda line: re.match(rb"[tTrR][0-9A-Fa-f]{4}", line) is not None,
        is_text=lambda line: bool(line.strip(_EMPTY)),
        kind=_line_kind,
        is_answer=lambda line, kind: line[:1] == kind,
        tells_kind=False,  # some firmware
    ),
    "usb2can": Protocol(
        size=_message_size,
        is_frame=lambda message: len(message) > 1 and message[1] in _FRAMES,
        is_text=lambda message: len(message) > 1 and message[1] != ERROR,
        kind=lambda message: message[:2] + message[3:4],  # 0F WRITE_REG register
        is_answer=_is_answer,
        tells_kind=True,
    ),
}
"""By the type of adapter that the capture's first line names."""


class Piece(NamedTuple):
    """What the device said, and how much its host had said before."""

    at: float
    data: bytes
    commands: int
    frames: int
    after_s: float  # the last of these


class Answer(NamedTuple):
    """To a question."""

    after_s: float
    data: bytes


class Command(NamedTuple):
    """Of the host, but for questions."""

    at: float
    kind: bytes


@dataclass
class Script:
    """All that was said; what is played is taken out."""

    protocol: Protocol
    begins_at: float = 0.0  # the host
    commands: list[Command] = field(default_factory=list)
    answers: dict[bytes, deque[Answer]] = field(default_factory=lambda: defaultdict(deque))  # by kind
    replies: deque[Piece] = field(default_factory=deque)  # soon after a command or frame
    usual: dict[bytes, list[Answer]] = field(default_factory=dict)  # by kind, those to the last command of it
    pieces: deque[Piece] = field(default_factory=deque)  # the rest


def read(path: Path) -> Script:
    """PortError if it is no capture. A last line without its end was not finished, and is left out."""
    try:
        text = path.read_bytes().decode("ascii", "replace")
    except OSError as error:
        raise PortError(f"{path}: cannot be read: {error.strerror}") from error
    head, *lines = text.split("\n")[:-1] or [""]
    type_ = next((word[5:] for word in head.split() if word.startswith("type=")), "")
    if not head.startswith(_HEAD) or type_ not in PROTOCOLS:
        kinds = " or ".join(f"type={name}" for name in PROTOCOLS)
        raise PortError(f"{path}: line 1 is not that of a capture: {_HEAD}… {kinds} …")
    reader = _Reader(PROTOCOLS[type_])
    for number, line in enumerate(lines, 2):
        if line.startswith("#") or not line.strip():
            continue
        match = _PIECE.fullmatch(line.rstrip("\r "))
        if not match:
            raise PortError(f"{path}: line {number} is not SECONDS > BYTES, or <: {line[:40]!r}")
        reader.take(float(match[1]), match[2], _ESCAPE.sub(_character, match[3]).encode("latin-1"))
    return reader.script()


def _character(match: re.Match[str]) -> str:
    escape = match[1]
    return chr(int(escape[1:], 16)) if len(escape) > 1 else _CHARACTERS[escape]


class _Reader:
    """Takes what was said in its order."""

    def __init__(self, protocol: Protocol) -> None:
        self._script = Script(protocol)
        self._begun = {">": b"", "<": b""}
        self._commands: list[Command | None] = []  # None: a question
        self._pending: list[int] = []  # of these, without an answer
        self._frames = 0
        self._usual: list[Answer] = []  # to the last command
        self._last_at: float | None = None  # when the host said something

    def take(self, at: float, way: str, data: bytes) -> None:
        if way == ">" and self._last_at is None:
            self._script.begins_at = self._last_at = at
        units, self._begun[way] = self._script.protocol.cut(self._begun[way] + data)
        for unit in units:
            if way == ">":
                self._host_says(at, unit)
            else:
                self._device_says(at, unit)

    def script(self) -> Script:
        """With the places of commands counted without questions."""
        before = [0]
        for command in self._commands:
            before.append(before[-1] + (command is not None))
        script = self._script
        script.commands = [command for command in self._commands if command]
        for pieces in (script.replies, script.pieces):
            for _ in range(len(pieces)):
                piece = pieces.popleft()
                pieces.append(piece._replace(commands=before[piece.commands]))
        return script

    def _host_says(self, at: float, unit: bytes) -> None:
        self._last_at = at
        if self._script.protocol.is_frame(unit):
            self._frames += 1
            self._usual = []
        else:
            kind = self._script.protocol.kind(unit)
            self._pending.append(len(self._commands))
            self._commands.append(Command(at, kind))
            self._usual = self._script.usual[kind] = []

    def _device_says(self, at: float, unit: bytes) -> None:
        protocol = self._script.protocol
        after_s = at - self._last_at if self._last_at is not None else 0.0
        piece = Piece(at, unit, len(self._commands), self._frames, after_s)
        if protocol.is_frame(unit):
            self._script.pieces.append(piece)
        elif not (protocol.is_text(unit) and self._answers(at, unit)):
            if after_s <= ANSWER_S:
                self._script.replies.append(piece)
                self._usual.append(Answer(after_s, unit))
            else:
                self._script.pieces.append(piece)

    def _answers(self, at: float, text: bytes) -> bool:
        """Whether this is the answer to a question."""
        protocol = self._script.protocol
        recent = [place for place in self._pending if self._command(place).at >= at - QUESTION_S]
        alike = [place for place in recent if protocol.is_answer(text, self._command(place).kind)]
        if not alike and (protocol.tells_kind or not recent):
            return False
        place = (alike or recent)[-1]
        question = self._command(place)
        self._pending.remove(place)
        self._commands[place] = None
        self._script.answers[question.kind].append(Answer(at - question.at, text))
        return True

    def _command(self, place: int) -> Command:
        command = self._commands[place]
        assert command is not None
        return command
