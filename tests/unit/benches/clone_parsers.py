"""How other firmware than a CAN232's reads its command line: small models of the parsers, no CAN, no time of
their own. What is known of each (answers, longest line, what half a command does) was measured on the real
firmware; where that says nothing, a model does what puts more frames on the bus.

`effects` is what cannot be taken back: frames on the bus, register and flash writes, the bootloader.
"""

import math
import re
from typing import ClassVar

from bridged.simulators.can232 import Can232 as Simulator

CR, BELL = b"\r", b"\a"
HEX = b"0123456789ABCDEFabcdef"
DIGITS = {b"t": 3, b"r": 3, b"d": 3, b"b": 3, b"T": 8, b"R": 8, b"D": 8, b"B": 8}
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)


class Firmware:
    """A line of up to `longest` characters; `overflow` is what becomes of one that is longer.

    anew        the line is empty again
    BELL        the same, and told
    last byte   what comes is written over the last character: the head stays
    lost        the line is thrown away, with its CR
    """

    longest: ClassVar[int] = 32
    overflow: ClassVar[str] = "anew"
    forgets_after_s: ClassVar[float] = math.inf
    version: ClassVar[bytes] = b""
    serial_number: ClassVar[bytes] = b""

    def __init__(self, *, is_open: bool = False) -> None:
        self.is_open = is_open
        self.effects: list[str] = []
        self.commands: list[bytes] = []  # that it carried out, or refused
        self._line = bytearray()
        self._lost = False
        self._last_s = -math.inf
        self._output = b""

    def host_writes(self, now: float, data: bytes) -> None:
        if now - self._last_s > self.forgets_after_s:
            self._line.clear()
        self._last_s = now
        for byte in data:
            if byte == CR[0]:
                self._end_line()
            else:
                self._store(byte)

    def take_output(self, _now: float) -> bytes:
        output, self._output = self._output, b""
        return output

    def _store(self, byte: int) -> None:
        if len(self._line) >= self.longest:
            match self.overflow:
                case "last byte":
                    self._line.pop()
                case "lost":
                    self._lost = True
                    return
                case "BELL":
                    self._output += BELL
                    self._line.clear()
                case _:
                    self._line.clear()
        self._line.append(byte)

    def _end_line(self) -> None:
        line, lost = bytes(self._line), self._lost
        self._line.clear()
        self._lost = False
        self._output += self.too_long(line) if lost else self._answer(line)

    def _answer(self, line: bytes) -> bytes:
        self.commands.append(line)
        return self.lone_cr() if not line else self.carry_out(line[:1], line[1:])

    def too_long(self, _line: bytes) -> bytes:
        return BELL

    def lone_cr(self) -> bytes:
        return BELL

    def carry_out(self, letter: bytes, rest: bytes) -> bytes:
        raise NotImplementedError

    def put_on_bus(self, frame: bytes) -> None:
        self.effects.append(f"frame {frame.decode('ascii', 'replace')}")


def is_frame(letter: bytes, rest: bytes, *, fd: bool = False, remote_data: bool = False) -> bool:
    """A command for a frame with as many digits as it must have."""
    digits = DIGITS[letter]
    if len(rest) <= digits or any(byte not in HEX for byte in rest):
        return False
    dlc = int(rest[digits : digits + 1], 16)
    if dlc > (15 if fd else 8):
        return False
    length = FD_LENGTHS[dlc] if letter not in b"rR" or remote_data else 0
    return len(rest) == digits + 1 + 2 * length


class Strict(Firmware):
    """Refuses whatever has not exactly the digits it must have."""

    letters: ClassVar[bytes] = b"tTrR"
    done: ClassVar[bytes] = CR
    malformed: ClassVar[bytes] = BELL
    remote_data: ClassVar[bool] = False

    def carry_out(self, letter: bytes, rest: bytes) -> bytes:
        if letter in self.letters:
            if not is_frame(letter, rest, fd=letter in b"dDbB", remote_data=self.remote_data):
                return self.malformed
            if not self.is_open:
                return BELL
            self.put_on_bus(letter + rest)
            return self.done
        return self.other(letter, rest)

    def other(self, letter: bytes, rest: bytes) -> bytes:
        raise NotImplementedError


class Canable1(Firmware):
    """canable-fw. One buffer, never cleared; digits become values in place, so old ones stay values."""

    longest = 30
    version = b"8ca5d39 https://github.com/normaldotcom/cantact-fw.git"
    letters: ClassVar[bytes] = b"tTrR"
    keeps_when_closed: ClassVar[bool] = True

    def __init__(self, *, is_open: bool = False) -> None:
        super().__init__(is_open=is_open)
        self._buffer = [0] * self.longest
        self._index = 0
        self._kept: list[bytes] = []

    def _store(self, byte: int) -> None:
        if self._index >= self.longest:
            self._index = 0
        self._buffer[self._index] = byte
        self._index += 1

    def _end_line(self) -> None:
        """A lone CR repeats what is in the buffer."""
        for i in range(1, self._index):
            byte = self._buffer[i]
            base = 0x61 - 10 if byte >= 0x61 else 0x41 - 10 if byte >= 0x41 else 0x30
            self._buffer[i] = byte - base
        self._index = 0
        letter = bytes((self._buffer[0] & 0xFF,))
        self.commands.append(letter)
        self._output += self.carry_out(letter, b"")

    def carry_out(self, letter: bytes, rest: bytes) -> bytes:
        if letter == b"V":
            return self.version + CR
        if letter == b"O":
            self.is_open = True
            for frame in self._kept:
                self.put_on_bus(frame)
            self._kept.clear()
        elif letter == b"C":
            self.is_open = False
        elif letter in self.letters:
            self._send(letter)
        return rest  # nothing

    def _send(self, letter: bytes) -> None:
        digits = DIGITS[letter]
        can_id = 0
        for value in self._buffer[1 : digits + 1]:
            can_id = (can_id << 4) + value
        dlc = self._buffer[digits + 1]
        if not 0 <= dlc <= (15 if letter in b"dDbB" else 8):
            return
        length = 0 if letter in b"rR" else FD_LENGTHS[dlc]
        values = (self._buffer[digits + 2 :] + [0] * 128)[: 2 * length]
        data = bytes((high << 4) + low & 0xFF for high, low in zip(values[::2], values[1::2], strict=True))
        mask, width = (0x7FF, 3) if digits == 3 else (0x1FFFFFFF, 8)
        frame = b"%s%0*X%X%s" % (letter, width, can_id & mask, dlc, data.hex().upper().encode())
        if self.is_open:
            self.put_on_bus(frame)
        elif self.keeps_when_closed:
            self._kept.append(frame)


class Canable2(Canable1):
    """canable2-fw."""

    longest = 155
    version = b"b158aa7 https://github.com/normaldotcom/canable2.git"
    letters = b"tTrRdDbB"
    keeps_when_closed = False

    def carry_out(self, letter: bytes, rest: bytes) -> bytes:
        if letter == b"X" and self.is_open:
            self.put_on_bus(b"X...")
        if letter == b"E":
            return b"0"
        return super().carry_out(letter, rest)


class Cantact(Canable1):
    """No V, no answers; what is longer than its buffer overwrites memory."""

    def _store(self, byte: int) -> None:
        if self._index >= self.longest:
            self.effects.append("memory overwritten")
        super()._store(byte)

    def carry_out(self, letter: bytes, rest: bytes) -> bytes:
        if letter in b"FK":
            self.effects.append("filter set")
        return b"" if letter == b"V" else super().carry_out(letter, rest)


class Naka(Strict):
    """Nakakiyo092's firmware for the CANable 2.0."""

    longest = 165
    version = b"VL2K4"
    letters = b"tTrRdDbB"
    done = b"z\r"

    def lone_cr(self) -> bytes:
        return CR

    def other(self, letter: bytes, rest: bytes) -> bytes:
        match letter:
            case b"V" if not rest:
                return self.version + CR
            case b"v" if not rest:
                return b'v: hardware="CANable2.0", software="1.0"\r'
            case b"N" if len(rest) == 4:
                self.effects.append("flash written by N")
                return CR
            case b"Q" if self.is_open:
                self.effects.append("flash written by Q")
                return CR
            case b"F" if self.is_open:
                return b"F00\r"
            case b"C" if self.is_open and not rest:
                self.is_open = False
                return CR
            case b"O" | b"L" if not self.is_open and not rest:
                self.is_open = True
                return CR
            case b"S" | b"M" | b"m" if not self.is_open:
                return CR
        return BELL


class NakaFd(Naka):
    """Its sister for the USB2CANFDV1: X in whatever shape enters the bootloader."""

    version = b"VW1K2"

    def other(self, letter: bytes, rest: bytes) -> bytes:
        if letter == b"X":
            self.effects.append("bootloader")
            return b""
        return super().other(letter, rest)


class Weact(Strict):
    """USB2CANFDV1. Half a command is forgotten after 10 ms; a lone CR begins the next command."""

    longest = 139
    overflow = "last byte"
    forgets_after_s = 0.010
    version = b"WeAct Studio V1.0.0.8_20250401"
    letters = b"tTrRdDbB"

    def _end_line(self) -> None:
        if self._line:
            super()._end_line()
        else:
            self._line += CR

    def other(self, letter: bytes, rest: bytes) -> bytes:
        match letter:
            case b"V" if not rest:
                return self.version + CR
            case b"X" if not rest and not self.is_open:
                self.effects.append("bootloader")
                return b""
            case b"C" | b"O" if not rest:
                self.is_open = letter == b"O"
                return CR
            case b"S":
                return CR
            case b"A" | b"M" if rest in {b"0", b"1"} and not self.is_open:
                return CR
        return BELL


class Elmue(Firmware):
    """CANable 2.5: too few digits are taken, wrong ones and too many are not."""

    longest = 165
    version = (
        b"+Board: MksMakerbase\tMCU: STM32G431\tDevID: 1128\tFirmware: 2508001\tSlcan: 100\tClock: 160\t"
        b"Limits: 512,256,128,128,32,32,16,16\tFeatures: 1023\tFilters: 8\tTimings: 4\t"
        b"Serial: 207A32585541500E"
    )

    def lone_cr(self) -> bytes:
        return CR

    def carry_out(self, letter: bytes, rest: bytes) -> bytes:
        if letter in b"tTrR":
            digits = DIGITS[letter]
            dlc = rest[digits : digits + 1]
            longest = digits + 1 + (2 * int(dlc) if dlc.isdigit() and letter in b"tT" else 0)
            if not self.is_open or any(byte not in HEX for byte in rest) or len(rest) > longest:
                return BELL
            self.put_on_bus(letter + rest)
            return CR
        match letter:
            case b"V" if not rest:
                return self.version + CR
            case b"C" if not rest:
                self.is_open = False
                return b""
            case b"O" if not rest and not self.is_open:
                self.is_open = True
                return CR
            case b"F" if not rest:
                return CR
            case b"*":
                self.effects.append("flash written, or bootloader")
                return CR
            case b"S" if not self.is_open:
                return CR
        return BELL


class Usbtin(Firmware):
    """Version 1.4. The head of a line that is too long stays. What follows a whole command is ignored."""

    longest = 100
    overflow = "last byte"
    version, serial_number = b"V0100", b"NFFFF"

    def _store(self, byte: int) -> None:
        if byte != 0x0A:
            super()._store(byte)

    def carry_out(self, letter: bytes, rest: bytes) -> bytes:
        if letter in b"tTrR":
            for end in range(len(rest) + 1):
                if is_frame(letter, rest[:end]) and self.is_open:
                    self.put_on_bus(letter + rest[:end])
                    return b"z\r" if letter in b"tr" else b"Z\r"
            return BELL
        match letter:
            case b"V":
                return self.version + CR
            case b"v":
                return b"v0104\r"
            case b"N":
                return self.serial_number + CR
            case b"F":
                return b"F00\r"
            case b"W" if re.match(b"[0-9A-F]{4}", rest):
                self.effects.append("register written")
                return CR
            case b"C" if self.is_open:
                self.is_open = False
                return CR
            case b"O" | b"L" | b"S" | b"s" | b"M" | b"m" if not self.is_open:
                self.is_open = letter in b"OL"
                return CR
            case b"Z":
                return CR
        return BELL


def _leading_hex(text: bytes) -> int:
    """As strtoul: digits up to the first character that is none."""
    match = re.match(b"[0-9A-Fa-f]*", text)
    return int(match[0], 16) if match and match[0] else 0


class Esp32(Firmware):
    """mintynet's esp32-slcan: too few digits are taken, and so is what is none."""

    longest = 32
    overflow = "BELL"
    version, serial_number = b"V1234", b"N2233"

    def carry_out(self, letter: bytes, rest: bytes) -> bytes:
        if letter in b"tTrR":
            if self.is_open:
                digits = DIGITS[letter]
                can_id, dlc = _leading_hex(rest[:digits]), _leading_hex(rest[digits : digits + 1])
                kind = b"R" if letter == b"r" else letter
                self.put_on_bus(b"%s%0*X%X%s" % (kind, digits, can_id, dlc, rest[digits + 1 :]))
            return CR
        match letter:
            case b"V":
                return self.version + CR
            case b"N":
                return self.serial_number + CR
            case b"F":
                return b"F00\r"
            case b"C" | b"O":
                changed = self.is_open != (letter == b"O")
                self.is_open = letter == b"O"
                return CR if changed else b""
            case b"S" | b"M" | b"m" | b"Z":
                return CR
        return BELL


class Uino(Firmware):
    """kahiroka's slcanuino: open from power-on, whatever C says. Frames with wrong digits: CR, not sent."""

    longest = 32
    overflow = "BELL"
    version, serial_number = b"V1234", b"N1234"

    def carry_out(self, letter: bytes, rest: bytes) -> bytes:
        if letter in b"tTrR":
            if is_frame(letter, rest, remote_data=True):
                self.put_on_bus(letter + rest)
            return CR
        match letter:
            case b"V":
                return self.version + CR
            case b"N":
                return self.serial_number + CR
            case b"F":
                return b"F12\r"
            case b"C" | b"O" | b"S" | b"M" | b"m" | b"Z":
                return CR
        return BELL


class Cato(Strict):
    """catompiler's slave library: what is malformed or too long has no answer."""

    longest = 32
    overflow = "lost"
    version, serial_number = b"V0103", b"N1234"
    malformed = b""

    def too_long(self, _line: bytes) -> bytes:
        return b""

    def other(self, letter: bytes, rest: bytes) -> bytes:
        match letter:
            case b"V" | b"N" | b"F" | b"C" | b"O" | b"L" | b"A" | b"P" if rest:
                return b""
            case b"V":
                return self.version + CR
            case b"N":
                return self.serial_number + CR
            case b"F" if self.is_open:
                return b"F00\r"
            case b"A" if self.is_open:
                return b"A\r"
            case b"C" if self.is_open:
                self.is_open = False
                return CR
            case b"O" | b"L" if not self.is_open:
                self.is_open = True
                return CR
            case b"S" | b"s" | b"M" | b"m" if not self.is_open:
                return CR
            case b"X" | b"U" | b"Z" | b"Q" | b"W":
                self.effects.append("setting written")
                return CR
        return BELL


class Slcanpty(Strict):
    """can-utils. What follows the identifier of a remote frame is read as the next command."""

    longest = 1000
    version, serial_number = b"V1013", b"N4242"

    def carry_out(self, letter: bytes, rest: bytes) -> bytes:
        digits = DIGITS.get(letter, 0)
        if letter in b"rR" and len(rest) > digits and all(byte in HEX for byte in rest[:digits]):
            if self.is_open:
                self.put_on_bus(letter + rest[:digits] + b"0")
            return CR + BELL
        return super().carry_out(letter, rest)

    def other(self, letter: bytes, rest: bytes) -> bytes:
        match letter:
            case b"V":
                return self.version + CR
            case b"N":
                return self.serial_number + CR
            case b"F":
                return b"F00\r"
            case b"C" | b"O":
                self.is_open = letter == b"O"
                return CR
            case b"S" | b"M" | b"m":
                return CR
            case b"X" if rest == b"1":
                return CR
        return BELL


class Reference(Firmware):
    """The simulator of a CAN232, which follows the manual."""

    def __init__(self, *, is_open: bool = False) -> None:
        super().__init__()
        self.device = Simulator()
        if is_open:
            self.device.host_writes(0.0, b"S4\rO\r")
            self.device.advance(0.0)
            self.device.take_output(0.0)

    def host_writes(self, now: float, data: bytes) -> None:
        self.device.host_writes(now, data)

    def take_output(self, now: float) -> bytes:
        output = self.device.take_output(now)
        self.device.advance(now)
        self.effects += [f"frame {frame}" for frame in self.device.take_bus_frames()]
        return output


OTHERS: tuple[type[Firmware], ...] = (
    Canable1,
    Canable2,
    Naka,
    NakaFd,
    Weact,
    Elmue,
    Usbtin,
    Esp32,
    Uino,
    Cato,
    Slcanpty,
)
