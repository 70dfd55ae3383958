"""Makes identifiers and data in the bytes between host and adapter unrecognisable, for captures.

An identifier becomes another one of its kind, the same always the same; data becomes zeros. Kind and DLC of a
frame stay, so does the number of bytes. What is no frame stays as it is. Both directions are alike.
"""

from __future__ import annotations

import random
import re
from typing import Final, Protocol


class MaskedIds:
    """Other identifiers, chosen at random and remembered: no two become the same, none stays itself."""

    def __init__(self) -> None:
        self._random = random.SystemRandom()
        order = list(range(1 << 11))
        self._random.shuffle(order)
        self._standard = dict(zip(order, order[1:] + order[:1], strict=True))
        self._extended: dict[int, int] = {}
        self._used: set[int] = set()

    def standard(self, can_id: int) -> int:
        return self._standard[can_id]

    def extended(self, can_id: int) -> int:
        while can_id not in self._extended:
            other = self._random.getrandbits(29)
            if other != can_id and other not in self._used:
                self._extended[can_id] = other
                self._used.add(other)
        return self._extended[can_id]


class Mask(Protocol):
    """One direction of one line."""

    def feed(self, data: bytes) -> bytes:
        """The masked bytes; the beginning of what may become a frame is kept until its end is there."""

    def flush(self) -> bytes:
        """What was kept, masked: nothing follows it."""


# --- lines: `t1232AABB` -------------------------------------------------------------------------

_END: Final = re.compile(rb"[\r\a]")
_DIGIT: Final = re.compile(rb"[0-9A-Fa-f]")
# A line of digits may also be a CAN FD frame of some clones. `b158aa7 https://…` is none, but a version.
_FRAME: Final = re.compile(rb"(^[bdBD](?=[0-9A-Fa-f]{4,}\r)|[tTrR])([0-9A-Fa-f]*)([^tTrR]*)")
_ACCEPTANCE: Final = re.compile(rb"[Mm][0-9A-Fa-f]{8}\r")
_FIRST: Final = frozenset(b"tTrRbBdDmM")
_LONGEST: Final = 1 + 8 + 1 + 128 + 8 + 1  # T, identifier, DLC, data of a CAN FD frame, time stamp, CR


class LineMask:
    """Of the CAN232's protocol, as also its clones speak it.

    In a line that begins as a frame each digit behind the DLC becomes 0, time stamps too; in one that is
    longer than any frame each digit. Acceptance code and mask (M, m) become 0: they tell identifiers.
    """

    def __init__(self, ids: MaskedIds) -> None:
        self._ids = ids
        self._kept = b""
        self._at_start = True  # of a line
        self._overlong = False

    def feed(self, data: bytes) -> bytes:
        data = self._kept + data
        self._kept = b""
        masked = []
        while data:
            end = _END.search(data)
            is_frame = self._at_start and data[0] in _FIRST
            if is_frame and end is None and len(data) <= _LONGEST:
                self._kept = data
                break
            line = data[: end.end()] if end else data
            self._overlong = self._overlong or (is_frame and len(line) > _LONGEST)
            if self._overlong:
                masked.append(_DIGIT.sub(b"0", line))
            else:
                masked.append(self._mask(line) if is_frame else line)
            self._at_start = end is not None
            self._overlong = self._overlong and end is None
            data = data[len(line) :]
        return b"".join(masked)

    def flush(self) -> bytes:
        kept, self._kept = self._kept, b""
        self._at_start, self._overlong = True, False
        return self._mask(kept)

    def _mask(self, line: bytes) -> bytes:
        if _ACCEPTANCE.fullmatch(line):
            return _DIGIT.sub(b"0", line)
        first = _FRAME.match(line)
        return _FRAME.sub(self._mask_frame, line) if first and first[2] else line

    def _mask_frame(self, match: re.Match[bytes]) -> bytes:
        letter, digits, rest = match.groups()
        if not digits:  # a word
            return match[0]
        length = 3 if letter.islower() else 8
        if len(digits) <= length:  # cut off
            return letter + b"0" * len(digits) + _DIGIT.sub(b"0", rest)
        can_id = digits[:length]
        other = self._other(int(can_id, 16), length)
        if can_id != can_id.upper():
            other = other.lower()
        zeros = b"0" * (len(digits) - length - 1)
        return letter + other + digits[length : length + 1] + zeros + _DIGIT.sub(b"0", rest)

    def _other(self, can_id: int, length: int) -> bytes:
        """As many digits; bits that no identifier has stay."""
        if length == 3:
            return b"%03X" % (can_id & ~0x7FF | self._ids.standard(can_id & 0x7FF))
        return b"%08X" % (can_id & ~0x1FFFFFFF | self._ids.extended(can_id & 0x1FFFFFFF))


# --- messages: 0F COMMAND LENGTH DATA -----------------------------------------------------------

_START: Final = 0x0F
_HEAD: Final = 3
_LENGTH_MAX: Final = 16
_ERROR, _CAN_TRANSMIT = 9, 0
_FRAMES: Final = (63, 64, 65)  # READ_MESSAGE_TS, WRITE_MESSAGE, READ_MESSAGE
_REGISTERS: Final = (16, 18, 20)  # READ_REG, WRITE_REG, WRITE_READ_REG
_ACCEPTANCE_REGISTERS: Final = range(16, 24)  # ACR0-3, AMR0-3
_EXTENDED: Final = 0x80


class MessageMask:
    """Of the USB2CAN's protocol. Time stamps, and the acceptance registers' values, become 0."""

    def __init__(self, ids: MaskedIds) -> None:
        self._ids = ids
        self._kept = b""

    def feed(self, data: bytes) -> bytes:
        data = self._kept + data
        self._kept = b""
        masked = []
        while data:
            start = data.find(_START)
            size = start if start > 0 else 1
            if start < 0:
                size = len(data)
            elif start == 0:
                length = data[2] if len(data) >= _HEAD else 0
                if length <= _LENGTH_MAX:  # else it is no message: the byte is skipped
                    size = _HEAD + length
                if len(data) < size:
                    self._kept = data
                    break
            piece = data[:size]
            masked.append(self._mask(piece) if len(piece) > _HEAD and start == 0 else piece)
            data = data[size:]
        return b"".join(masked)

    def flush(self) -> bytes:
        kept, self._kept = self._kept, b""
        return kept[:_HEAD] + bytes(len(kept[_HEAD:]))

    def _mask(self, message: bytes) -> bytes:
        head, data = message[:_HEAD], message[_HEAD:]
        if head[1] in _FRAMES:
            return head + self._mask_frame(data)
        if head[1] == _ERROR and data[0] == _CAN_TRANSMIT:
            return head + data[:1] + self._mask_frame(data[1:])
        if head[1] in _REGISTERS and data[0] in _ACCEPTANCE_REGISTERS:
            return head + data[:1] + bytes(len(data) - 1)
        return message

    def _mask_frame(self, data: bytes) -> bytes:
        info, rest = data[:1], data[1:]
        extended = bool(info) and info[0] >= _EXTENDED
        size, shift = (4, 3) if extended else (2, 5)
        if len(rest) < size:
            return info + bytes(len(rest))
        value = int.from_bytes(rest[:size])
        below = value & (1 << shift) - 1  # also what shows RTR
        other = self._ids.extended(value >> shift) if extended else self._ids.standard(value >> shift)
        return info + (other << shift | below).to_bytes(size) + bytes(len(rest) - size)


MASKS: Final[dict[str, type[LineMask | MessageMask]]] = {"can232": LineMask, "usb2can": MessageMask}
"""By the type of adapter."""
