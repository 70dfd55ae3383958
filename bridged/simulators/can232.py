"""A LAWICEL CAN232, version 3, as its manual (3.0A, May 2012) describes it; no I/O, no clock of its own.

How the firmware works, where the manual leaves it open: characters come in by interrupt into two line
buffers; a line that begins while both are taken is lost. The main loop does one thing at a time: it carries
out a command and sends the answer, or else sends one received frame, and waits until the last character is
out; only then is the buffer of that command free. Commands go before frames.

Decided here because the manual does not say: a lone CR answers CR (1.2: ENTER "will make a new line"); `R`
answers Z, as devices do, where the manual prints z; hex digits are upper case, as in all its examples;
closing drops what is in the FIFOs; a frame stays in the transmit FIFO until it is on the bus; bits 0 and 1
of the flags mean that a frame did not fit; time stamps count from power-on; U takes effect after its answer;
a channel that Q opened sends by itself whatever X says, until it is closed.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import re
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final, NamedTuple

from bridged.simulators.can232_memory import Counters, Eeprom, load_eeprom
from bridged.simulators.device import OwnFault
from bridged.simulators.options import matching, whole
from bridged.simulators.sja1000 import Frame, accepts, bitrate, frame_bits
from bridged.simulators.uart import Uart

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Mapping

TITLE: Final = "LAWICEL CAN232"
ADAPTER: Final = {"type": "can232"}

OK = b"\r"
BELL = b"\a"

TRANSMIT_FIFO = 8
RECEIVE_FIFO = 32
LINE_BUFFERS = 2
LINE_BUFFER_CHARS = 27  # "Tiiiiiiiildddddddddddddddd" and its CR
BITRATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
UART_RATES = (230_400, 115_200, 57_600, 38_400, 19_200, 9_600, 2_400)
STAMP_PERIOD_MS = 60_000
ROUNDING_MS = 1e-6  # 0.001 * 1000 is less than 1 in some sums
ACCEPT_ALL = b"\xff\xff\xff\xff"

V1220 = 1220  # the first version with X, W, Z, Q

RECEIVE_FIFO_FULL = 0x01
TRANSMIT_FIFO_FULL = 0x02
ERROR_WARNING = 0x04
ERROR_PASSIVE = 0x20
BUS_ERROR = 0x80
BUS_OFF_FLAGS = ERROR_WARNING | ERROR_PASSIVE | BUS_ERROR


class State(enum.Enum):
    """Of the CAN channel; bit rate and filters survive closing, not power-off."""

    UNINITIATED = "uninitiated"  # no S or s since power-on
    CLOSED = "closed"
    OPEN = "open"
    LISTEN_ONLY = "listen-only"


def _refuse_all(device: Can232, _now: float, times: int) -> None:
    device.refuses_all = bool(times)


FAULTS: Final = {"refuseall": OwnFault("it refuses each command", switch=_refuse_all)}


class Can232:
    """The device with its RS232 line; times in seconds of the caller's clock, which must not go back.

    `version` as `V` answers it; older than V1220 has no X, W, Z, Q. `processing_s` is what a command takes.
    A `uart` with one of the manual's rates counts as set up by `U` before. Faults are the attributes
    `silent` (nothing is sent, commands are carried out), `refusals` (so many frames from the host are
    answered BELL), `refuses_all` (every command is), `drop_answers` (so many answers are lost), bits set in
    `flags`, and the methods below.
    ValueError if the version is none.
    """

    own_faults: ClassVar[Mapping[str, OwnFault]] = FAULTS

    def __init__(
        self,
        now: float = 0.0,
        *,
        eeprom: Eeprom | None = None,
        uart: Uart | None = None,
        version: str = "V1324",
        serial_number: str = "A123",
        processing_s: float = 0.0,
    ) -> None:
        self.eeprom = eeprom or Eeprom()
        self.uart = uart or Uart()
        self.version = version
        self.serial_number = serial_number
        self.processing_s = processing_s
        self.counters = Counters()
        self.silent = False
        self.refusals = 0
        self.refuses_all = False
        self.drop_answers = 0
        self.bus_off = False
        if self.uart.baud in UART_RATES:
            self.eeprom.uart = UART_RATES.index(self.uart.baud)
        self._software = int(version[1:])
        if self._software < V1220:
            self.eeprom.auto_poll = self.eeprom.time_stamps = self.eeprom.single_filter = False
            self.eeprom.auto_start = 0
        self._to_bus: list[Frame] = []
        self._fifo: deque[Frame] = deque()
        self._clock = now
        self._boot()

    def _boot(self) -> None:
        """What is not in the EEPROM gets its default value."""
        eeprom = self.eeprom
        self.powered = True
        self.state = State.UNINITIATED
        self.bitrate = 0.0
        self.code = bytes(4)
        self.mask = ACCEPT_ALL
        self.flags = 0
        self._errors = 0  # the higher of the controller's error counters
        self._auto_started = bool(eeprom.auto_start)
        self._power_on = self._clock
        self._head_done = math.inf  # when the first frame of the transmit FIFO is on the bus
        self._received: deque[tuple[Frame, int]] = deque()  # frame, time stamp in ms
        self._line = bytearray()
        self._losing = False  # the rest of this line
        self._waiting: deque[bytes] = deque()  # lines, not yet carried out
        self._released: deque[float] = deque()  # when the line buffers of those carried out are free again
        self._free_at = self._clock  # the main loop
        self._new_baud: int | None = None  # once the answer to U is out
        if self.uart.baud in UART_RATES:
            self.uart.baud = UART_RATES[eeprom.uart]
        if self._auto_started:
            self.bitrate = eeprom.bitrate
            self.code, self.mask = bytes.fromhex(eeprom.code), bytes.fromhex(eeprom.mask)
            self.state = State.OPEN if eeprom.auto_start == 1 else State.LISTEN_ONLY

    @property
    def title(self) -> str:
        return f"CAN232 {self.serial_number}"

    def power_on(self, now: float) -> None:
        """Power is back, or the device is plugged in; it starts at once."""
        self.advance(now)
        self._boot()

    def power_off(self, now: float) -> None:
        """The power fails, or the device is unplugged: nothing goes in or out until `power_on`."""
        self.advance(now)
        self.powered = False
        self._waiting.clear()
        self._discard_frames()
        self.uart.cut_off(self._clock)

    def power_cycle(self, now: float) -> None:
        """Off and on again at once, or a reset behind the host's back."""
        self.power_off(now)
        self.power_on(now)

    def set_bus_off(self, now: float, bus_off: bool) -> None:
        """Bus-off: nothing leaves the transmit FIFO, and the flags say so as long as it lasts."""
        self.advance(now)
        if bus_off != self.bus_off:
            self.bus_off = bus_off
            self._start_sending(self._clock)

    def set_listen_only(self, now: float, listen_only: bool) -> None:
        """An open channel is in listen-only mode, which its host did not want, until it is opened again."""
        self.advance(now)
        if self.state in _IS_OPEN:
            self.state = State.LISTEN_ONLY if listen_only else State.OPEN

    def set_error_counters(self, now: float, tec: int, rec: int) -> None:
        """Errors on the bus: the flags tell of each limit that is crossed, either way (EI, EPI)."""
        self.advance(now)
        for limit, flag in ((96, ERROR_WARNING), (128, ERROR_PASSIVE)):
            if (max(tec, rec) >= limit) != (self._errors >= limit):
                self.flags |= flag
        self._errors = max(tec, rec)

    def garbage(self, now: float, noise: bytes) -> None:
        """Noise on the line to the host."""
        self.advance(now)
        self.uart.transmit(self._clock, noise)

    def host_writes(self, now: float, data: bytes) -> None:
        """The host gave characters to its UART at `now`."""
        self.uart.host_writes(now, data, self._clock)

    def bus_frame(self, now: float, frame: Frame) -> None:
        """A frame was on the bus at `now`."""
        self.advance(now)
        counters = self.counters
        if not self._is_open():
            counters.frames_unseen += 1
            return
        if self.mask != ACCEPT_ALL and not accepts(self.code, self.mask, self.eeprom.single_filter, frame):
            counters.frames_filtered += 1
            return
        if len(self._received) >= RECEIVE_FIFO:
            self.flags |= RECEIVE_FIFO_FULL
            counters.frames_lost += 1
            return
        counters.frames_received += 1
        stamp = int((self._clock - self._power_on) * 1000 + ROUNDING_MS) % STAMP_PERIOD_MS
        self._received.append((frame, stamp))

    def advance(self, now: float) -> None:
        """Live through everything up to `now`, each thing at its own time, in order."""
        uart = self.uart
        while True:
            arrival = uart.arrival
            if self._has_work():
                start = max(self._free_at, self._clock)
                if start <= now and start <= arrival:
                    self._clock = start
                    self._turn(start)
                    continue
            if arrival > now:
                break
            self._clock = max(self._clock, arrival)
            self._store(*uart.take_arrived())
        self._clock = max(self._clock, now)
        self._send_due(self._clock)

    def take_output(self, now: float) -> bytes:
        """What has reached the host by `now`; tell `uart.delivered` when it really got it."""
        self.advance(now)
        return self.uart.deliver(now)

    def take_bus_frames(self) -> list[Frame]:
        """The frames put on the bus up to the last `advance`."""
        frames, self._to_bus = self._to_bus, []
        return frames

    def next_deadline(self) -> float:
        """When something can be seen on either side, if nothing else happens before; math.inf if never."""
        uart = self.uart
        # Nobody sees a command arrive. What is seen is its answer; most have two characters.
        deadline = min(self._head_done, uart.delivery, uart.arrival + 2 * uart.char_s)
        if self._has_work():
            deadline = min(deadline, max(self._free_at, self._clock))
        return deadline

    def report(self) -> dict[str, object]:
        """State, settings and counters, for a JSON file."""
        return {
            "channel": self.state.value,
            "bitrate": self.bitrate,
            "code": self.code.hex().upper(),
            "mask": self.mask.hex().upper(),
            "counters": vars(self.counters) | {"commands": dict(self.counters.commands)},
            "eeprom": dataclasses.asdict(self.eeprom),
        }

    # The main loop and its buffers

    def _store(self, first: float, piece: bytes) -> None:
        """Characters into a line buffer, if there is one; the first of them came at `first`."""
        if not self.powered:
            return
        line = self._line
        if not line and not self._losing:
            released = self._released
            while released and released[0] <= first:
                released.popleft()
            self._losing = len(released) + len(self._waiting) >= LINE_BUFFERS
        fits = 0 if self._losing else min(len(piece), LINE_BUFFER_CHARS - len(line))
        self.counters.rs232_lost += len(piece) - fits
        line += piece[:fits]
        if piece[-1] == OK[0]:
            if not self._losing:
                self._waiting.append(bytes(line[:-1]) if fits == len(piece) else bytes(line))
            self._losing = False
            line.clear()

    def _has_work(self) -> bool:
        return bool(self._waiting or (self._received and self._auto_poll()))

    def _turn(self, at: float) -> None:
        """One turn of the main loop: a command and its answer, or one received frame."""
        if self._waiting:
            answer = self._execute(self._waiting.popleft())
            if self.drop_answers:
                self.drop_answers -= 1
                self.counters.answers_dropped += 1
                answer = b""
            self._free_at = self._send(at + self.processing_s, answer)
            self._released.append(self._free_at)
            if self._new_baud:
                self.uart.baud, self._new_baud = self._new_baud, None
        else:
            self._free_at = self._send(at, self._pop_received())

    def _send(self, at: float, message: bytes) -> float:
        """Returns when the last character is out."""
        if self.silent or not message:
            return at + len(message) * self.uart.char_s
        return self.uart.transmit(at, message)

    def _execute(self, line: bytes) -> bytes:
        """Carry out one command, given without its CR, and return the answer."""
        counters = self.counters
        if not line:
            counters.commands["CR"] += 1
            return OK
        counters.commands[chr(line[0])] += 1
        rule = _RULES.get(line[0])
        if (
            rule is not None
            and not self.refuses_all
            and self.state in rule.states
            and self._software >= rule.since
            and rule.pattern.fullmatch(line)
        ):
            answer = rule.carry_out(self, line)
            if answer is not None:
                return answer
        counters.refused += 1
        return BELL

    # Towards the bus

    def _send_due(self, now: float) -> None:
        while self._head_done <= now:
            self._to_bus.append(self._fifo.popleft())
            self.counters.frames_sent += 1
            self._start_sending(self._head_done)

    def _start_sending(self, at: float) -> None:
        if self._fifo and not self.bus_off:
            self._head_done = at + frame_bits(self._fifo[0]) / self.bitrate
        else:
            self._head_done = math.inf

    def _discard_frames(self) -> None:
        self.counters.frames_discarded += len(self._fifo)
        self._fifo.clear()
        self._head_done = math.inf
        self._received.clear()

    def _is_open(self) -> bool:
        return self.powered and self.state in _IS_OPEN

    def _auto_poll(self) -> bool:
        return self.eeprom.auto_poll or self._auto_started

    def _pop_received(self) -> bytes:
        frame, stamp = self._received.popleft()
        if frame.extended:
            head = f"{'R' if frame.remote else 'T'}{frame.can_id:08X}"
        else:
            head = f"{'r' if frame.remote else 't'}{frame.can_id:03X}"
        text = f"{head}{frame.dlc}{frame.data.hex().upper()}"
        if self.eeprom.time_stamps:
            return f"{text}{stamp:04X}\r".encode()
        return f"{text}\r".encode()

    # Commands: None refuses

    def _set_bitrate(self, line: bytes) -> bytes:
        if line[:1] == b"S":
            self.bitrate = float(BITRATES[line[1] - 0x30])
        else:
            self.bitrate = bitrate(int(line[1:3], 16), int(line[3:5], 16))
        self.state = State.CLOSED
        return OK

    def _open(self, line: bytes) -> bytes:
        self.state = State.OPEN if line == b"O" else State.LISTEN_ONLY
        return OK

    def _close(self, _line: bytes) -> bytes:
        self._send_due(self._clock)
        self._discard_frames()
        self.state = State.CLOSED
        self._auto_started = False
        return OK

    def _transmit(self, line: bytes) -> bytes | None:
        self._send_due(self._clock)
        if self.refusals:
            self.refusals -= 1
            return None
        if len(self._fifo) >= TRANSMIT_FIFO:
            self.flags |= TRANSMIT_FIFO_FULL
            self.counters.refused_full += 1
            return None
        kind = line[:1]
        extended = kind in b"TR"
        digits = 9 if extended else 4
        frame = Frame(
            int(line[1:digits], 16),
            extended,
            kind in b"rR",
            line[digits] - 0x30,
            bytes.fromhex(line[digits + 1 :].decode()),
        )
        self._fifo.append(frame)
        self.counters.frames_taken += 1
        if len(self._fifo) == 1:
            self._start_sending(self._clock)
        if not self._auto_poll():
            return OK
        return b"Z\r" if extended else b"z\r"

    def _poll(self, line: bytes) -> bytes | None:
        if self._auto_poll():
            return None
        if line == b"P":
            return self._pop_received() if self._received else OK
        return b"".join(self._pop_received() for _ in range(len(self._received))) + b"A\r"

    def _read_flags(self, _line: bytes) -> bytes:
        flags = self.flags | (BUS_OFF_FLAGS if self.bus_off else 0)
        self.flags = 0
        return b"F%02X\r" % flags

    def _write_eeprom(self, line: bytes) -> bytes:
        eeprom = self.eeprom
        value = line[1] - 0x30
        match line[:1]:
            case b"X":
                eeprom.auto_poll = bool(value)
            case b"Z":
                eeprom.time_stamps = bool(value)
            case b"W":
                eeprom.single_filter = bool(value)
            case b"U":
                eeprom.uart = value
                self._new_baud = UART_RATES[value] if self.uart.baud in UART_RATES else None
            case _:
                eeprom.auto_start = value
                eeprom.bitrate = self.bitrate
                eeprom.code, eeprom.mask = self.code.hex().upper(), self.mask.hex().upper()
        eeprom.writes += 1
        return OK

    def _set_filter(self, line: bytes) -> bytes:
        value = bytes.fromhex(line[1:].decode())
        if line[:1] == b"M":
            self.code = value
        else:
            self.mask = value
        return OK

    def _get_version(self, _line: bytes) -> bytes:
        return f"{self.version}\r".encode()

    def _get_serial_number(self, _line: bytes) -> bytes:
        return f"N{self.serial_number}\r".encode()


class _Rule(NamedTuple):
    """How a command looks, in which states it works, what it does, and since which version."""

    pattern: re.Pattern[bytes]
    states: frozenset[State]
    carry_out: Callable[[Can232, bytes], bytes | None]
    since: int


_ALWAYS = frozenset(State)
_NOT_OPEN = frozenset({State.UNINITIATED, State.CLOSED})
_INITIATED = frozenset({State.CLOSED})
_IS_OPEN = frozenset({State.OPEN, State.LISTEN_ONLY})
_NORMAL = frozenset({State.OPEN})
_ID11 = "[0-7][0-9A-F]{2}"
_ID29 = "[01][0-9A-F]{7}"
_DATA = "(?:" + "|".join(f"{n}[0-9A-F]{{{2 * n}}}" for n in range(9)) + ")"

_RULES = {
    ord(letter): _Rule(re.compile((letter + rest).encode()), states, carry_out, since)
    for letters, rest, states, carry_out, since in (
        ("S", "[0-8]", _NOT_OPEN, Can232._set_bitrate, 0),
        ("s", "[0-9A-F]{4}", _NOT_OPEN, Can232._set_bitrate, 0),
        ("OL", "", _INITIATED, Can232._open, 0),
        ("C", "", _IS_OPEN, Can232._close, 0),
        ("t", _ID11 + _DATA, _NORMAL, Can232._transmit, 0),
        ("T", _ID29 + _DATA, _NORMAL, Can232._transmit, 0),
        ("r", _ID11 + "[0-8]", _NORMAL, Can232._transmit, 0),
        ("R", _ID29 + "[0-8]", _NORMAL, Can232._transmit, 0),
        ("PA", "", _IS_OPEN, Can232._poll, 0),
        ("F", "", _IS_OPEN, Can232._read_flags, 0),
        ("XZ", "[01]", _NOT_OPEN, Can232._write_eeprom, V1220),
        ("W", "[01]", _INITIATED, Can232._write_eeprom, V1220),
        ("Mm", "[0-9A-F]{8}", _INITIATED, Can232._set_filter, 0),
        ("U", "[0-6]", _NOT_OPEN, Can232._write_eeprom, 0),
        ("V", "", _ALWAYS, Can232._get_version, 0),
        ("N", "", _ALWAYS, Can232._get_serial_number, 0),
        ("Q", "[0-2]", _IS_OPEN, Can232._write_eeprom, V1220),
    )
    for letter in letters
}


# For `can-bridge simulate`


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--uart-rate",
        type=whole,
        metavar="BAUD",
        help="pace the line at this rate; default: as fast as it goes",
    )
    version = matching(r"V\d{4}", "a version like V1324")
    add("--version", type=version, default="V1324", dest="device_version", metavar="V", help="answer to V")
    serial = matching(r"[0-9A-Z]{4}", "a serial number like A123")
    add("--serial-number", type=serial, default="A123", metavar="N", help="answer to N, without the N")
    add("--eeprom", type=Path, metavar="FILE", help="keeps the EEPROM and its write count, as JSON")
    add("--precise", action="store_true", help="busy-wait for exact timing (uses a whole core)")


def make_device(now: float, args: argparse.Namespace) -> Can232:
    return Can232(
        now,
        eeprom=load_eeprom(args.eeprom),
        uart=Uart(args.uart_rate),
        version=args.device_version,
        serial_number=args.serial_number,
        processing_s=args.processing,
    )
