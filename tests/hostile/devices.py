"""What a CAN232 and a USB2CAN make of the bytes that they get, and what they answer: small and exact.

Not the simulators of the product: a mistake in those must not hide one in the bridge. Nothing here lies; what
does is in hostility.py.
"""

import re
from collections import deque
from collections.abc import Callable
from typing import Protocol

from frames import EXTENDED, FILLER


class Line(Protocol):
    """Who listens to a device."""

    def saw(self, can_id: int, data: bytes, since: float, *, sent: bool) -> int | None:
        """A frame came, not written before `since`; its number. `sent`: the device puts it on its bus."""

    def refused(self, number: int | None) -> None:
        """The device says that it did not take this frame."""

    def answer(self, data: bytes) -> None: ...


class Can232:
    """Lines of ASCII that end in CR (manual 2.0); firmware V1324 with auto poll."""

    FRAME = re.compile(rb"(t[0-7][0-9A-F]{2}|T[01][0-9A-F]{7})([0-8])((?:[0-9A-F]{2})*)")
    REMOTE = re.compile(rb"(?:r[0-7][0-9A-F]{2}|R[01][0-9A-F]{7})[0-8]")
    LONGEST = 26
    HONEST_REFUSAL = b"\a"

    def __init__(self, line: Line) -> None:
        self._line = line
        self.auto_poll = False
        self.refuses: Callable[[], bool] = lambda: False  # whether it has no room for a frame
        self.questions = 0  # about its health
        self.reset()

    def reset(self) -> None:
        """Loses its power for a moment; the EEPROM keeps auto poll."""
        self._open = self._configured = self._sends = False
        self._text = bytearray()
        self._since = 0.0

    @property
    def inside(self) -> bool:
        """It waits for the rest of a message."""
        return bool(self._text)

    def close(self) -> None:
        self._open = False

    def turn(self) -> None: ...

    def take(self, data: bytes, since: float) -> None:
        for byte in data:
            if byte == FILLER:
                continue
            if not self._text:
                self._since = since
            if byte != 0x0D:
                self._text.append(byte)
                continue
            text, self._text = bytes(self._text), bytearray()
            self._line.answer(self._execute(text))

    def _execute(self, text: bytes) -> bytes:
        frame = self.FRAME.fullmatch(text)
        if frame and len(frame[3]) == 2 * int(frame[2]):
            can_id = int(frame[1][1:], 16) | (EXTENDED if text[0] == 0x54 else 0)
            sent = self._sends and self._open and not self.refuses()
            number = self._line.saw(can_id, bytes.fromhex(frame[3].decode()), self._since, sent=sent)
            if not sent:
                self._line.refused(number)
                return b"\a"
            if not self.auto_poll:
                return b"\r"
            return b"Z\r" if can_id & EXTENDED else b"z\r"
        if self.REMOTE.fullmatch(text) and self._open:
            self._line.saw(0, b"", self._since, sent=True)
        return self._command(text)

    def _command(self, text: bytes) -> bytes:
        if len(text) > self.LONGEST:
            return b"\a"
        match text[:1]:
            case b"":
                return b"\r"
            case b"V" if len(text) == 1:
                return b"V1324\r"
            case b"N" if len(text) == 1:
                return b"NA123\r"
            case b"F" if self._open:
                self.questions += 1
                return b"F00\r"
            case b"A" if self._open and not self.auto_poll:
                return b"A\r"
            case b"C" if self._open and len(text) == 1:
                self._open = False
                return b"\r"
            case b"O" | b"L" if self._configured and not self._open and len(text) == 1:
                self._open, self._sends = True, text == b"O"
                return b"\r"
            case b"S" | b"s" if not self._open and re.fullmatch(b"S[0-8]|s[0-9A-F]{4}", text):
                self._configured = True
                return b"\r"
            case b"M" | b"m" if (
                self._configured and not self._open and re.fullmatch(b"[Mm][0-9A-F]{8}", text)
            ):
                return b"\r"
            case b"X" | b"Z" | b"W" if not self._open and re.fullmatch(b"[XZW][01]", text):
                if text[:1] == b"X":
                    self.auto_poll = text == b"X1"
                return b"\r"
        return b"\a"

    @staticmethod
    def received(can_id: int, data: bytes) -> bytes:
        """What it says when this frame comes from its bus."""
        head = f"T{can_id & 0x1FFFFFFF:08X}" if can_id & EXTENDED else f"t{can_id:03X}"
        return f"{head}{len(data)}{data.hex().upper()}\r".encode()

    @staticmethod
    def handed_back(can_id: int, data: bytes) -> bytes:  # noqa: ARG004 - BELL does not say which
        """What it says to the sender of a frame for which it had no room."""
        return b"\a"


def message(command: int, *data: int) -> bytes:
    return bytes((0x0F, command, len(data), *data))


def frame_bytes(can_id: int, data: bytes) -> bytes:
    if can_id & EXTENDED:
        return bytes((0x80 | len(data),)) + (can_id << 3 & 0xFFFFFFFF).to_bytes(4, "big") + data
    return bytes((len(data),)) + (can_id << 5).to_bytes(2, "big") + data


class Usb2can:
    """Messages 0F COMMAND LENGTH DATA (document, chapters II and III); firmware that tells its levels."""

    CAPACITY = 20  # frames
    BOOT, CONFIG, NORMAL = 0, 1, 2
    LENGTH_MAX = 13  # of WRITE_MESSAGE

    def __init__(self, line: Line) -> None:
        self._line = line
        self.full = False  # no frame leaves its buffer
        self.refuses: Callable[[], bool] = lambda: False  # whether it has no room although it should
        self.questions = 0  # about its health
        self.reset()

    def reset(self) -> None:
        """Loses its power for a moment."""
        self._mode = self.BOOT
        self._registers = bytearray(128)
        self._registers[0] = 1  # MOD: in reset
        self._critical = self._ready = 0
        self._waiting: deque[None] = deque()
        self._stopped = False
        self._looks = 0
        self._text = bytearray()
        self._since = 0.0

    @property
    def inside(self) -> bool:
        """It waits for the rest of a message."""
        return bool(self._text)

    def close(self) -> None:
        self._mode = self.CONFIG

    @property
    def waiting(self) -> int:
        return len(self._waiting)

    @property
    def stopped(self) -> bool:
        """It has said "stop", and not "go" yet, and whoever sends now must have heard it.

        Two questions came since: the second was put when the first was answered, which was after "stop".
        """
        return self._stopped and self._looks > 1

    def turn(self) -> None:
        """Frames leave it, unless it is full."""
        if not self.full:
            self._waiting.clear()
        if self._stopped and self.waiting < self._ready:
            self._stopped = False
            self._line.answer(message(9, 2, 0))

    def take(self, data: bytes, since: float) -> None:
        text = self._text
        for byte in data:
            other_command = len(text) > 1 and text[1] != 64  # may have it as data, a frame never
            if byte == FILLER and not other_command:
                continue
            if not text:
                if byte != 0x0F:
                    continue
                self._since = since
            text.append(byte)
            if len(text) < 3:
                continue
            if text[2] > self.LENGTH_MAX:
                text.clear()
            elif len(text) == 3 + text[2]:
                command, payload = text[1], bytes(text[3:])
                text.clear()
                self._execute(command, payload)

    def _execute(self, command: int, data: bytes) -> None:
        say = self._line.answer
        match command, len(data):
            case 2, 0:
                self._waiting.clear()
                self._stopped = False
                self._mode = self.CONFIG
            case 3, 0:
                self._mode = self.NORMAL
            case 6, 0:
                self.questions += 1
                say(message(6, self._mode))
            case 33, 0:
                say(message(33, *b"HW0003FW0016"))
            case 18, 2:
                self._registers[data[0] & 0x7F] = data[1]
                say(message(18, data[0]))
            case 16, 1:
                say(message(16, data[0], 0x0C if data[0] == 2 else self._registers[data[0] & 0x7F]))
            case 32, 2:
                if data[0] == 0:
                    self._critical = data[1]
                elif data[0] == 1:
                    self._ready = data[1]
            case 32, 1 if data[0] == 128:
                self._looks += 1
                say(message(32, 128, self._critical, self._ready, self.waiting, 0))
            case 96, 0:
                say(message(96, 0))
            case 97, 0:
                say(message(97, 0))
            case 98, 0:
                say(message(98, 0, 0))
            case 64, _:
                self._write(data)

    def _write(self, data: bytes) -> None:
        if not data:
            return
        on_bus = self._mode == self.NORMAL and not self._registers[0] & 1
        size = 4 if data[0] & 0x80 else 2
        length = data[0] & 0x0F
        if len(data) != 1 + size + length or length > 8 or data[0] & 0x70:
            if on_bus:
                self._line.saw(
                    0, b"", self._since, sent=True
                )  # nobody sends remote frames here, or such lengths
            return
        word = int.from_bytes(data[1 : 1 + size], "big")
        can_id = word >> 3 | EXTENDED if size == 4 else word >> 5
        if word & (7 if size == 4 else 31):
            can_id = 0  # bits that nobody sets
        has_room = self.waiting < self.CAPACITY and not self.refuses()
        number = self._line.saw(can_id, data[1 + size :], self._since, sent=on_bus and has_room)
        if not on_bus:
            return
        if not has_room:
            self._line.refused(number)
            self._line.answer(message(9, 0, *data))
            return
        self._waiting.append(None)
        if self.waiting > self._critical and not self._stopped:
            self._stopped = True
            self._looks = 0
            self._line.answer(message(9, 2, 1))

    @staticmethod
    def received(can_id: int, data: bytes) -> bytes:
        """What it says when this frame comes from its bus."""
        return message(65, *frame_bytes(can_id, data))

    @staticmethod
    def handed_back(can_id: int, data: bytes) -> bytes:
        """What it says to the sender of a frame for which it had no room."""
        return message(9, 0, *frame_bytes(can_id, data))
