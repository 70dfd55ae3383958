"""What the simulated clones of a CAN232 share: a command line, a transmit buffer, a controller on a CAN bus.

Firmware that speaks LAWICEL's letters but is no CAN232 has a file of its own, with what was measured on that
firmware; a fact that nobody knows is decided in the file's docstring. Here stands how such a device lives:
characters come in, a whole line is carried out, frames wait in a buffer until they have been on the bus, and
received frames become lines for the host.

`effects` of a device is what nobody can take back, in words: a register or flash write, a bootloader that was
started, an FD frame. Classic frames on the bus are in take_bus_frames().
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections import Counter
from typing import TYPE_CHECKING, ClassVar, Final, TypeVar

from bridged.simulators.device import OwnFault
from bridged.simulators.sja1000 import Frame, frame_bits
from bridged.simulators.uart import Uart

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

CR, BELL, NOTHING = b"\r", b"\a", b""
HEX: Final = frozenset(b"0123456789ABCDEFabcdef")
ID_DIGITS: Final = {b"t": 3, b"r": 3, b"d": 3, b"b": 3, b"T": 8, b"R": 8, b"D": 8, b"B": 8}
"""Letter of a frame → digits of its identifier; d, D, b, B are FD frames (b, B with a faster data phase)."""
FD_LENGTHS: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
RATES: Final = {
    f"S{n}".encode(): float(rate)
    for n, rate in enumerate((10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000))
}
"""Command → bit/s, as the CAN232's manual has them."""
STAMP_PERIOD_MS = 60_000

WARNING_FLAG, PASSIVE_FLAG, BUS_ERROR_FLAG = 0x04, 0x20, 0x80  # of F
LOST_FLAG = 0x08


class State(enum.Enum):
    """Of the CAN channel."""

    CLOSED = "closed"
    OPEN = "open"
    LISTEN_ONLY = "listen-only"


@dataclasses.dataclass
class Counters:
    """What happened since the simulator began; `frames_taken` = sent + discarded + still in the buffer."""

    commands: Counter[str] = dataclasses.field(default_factory=Counter)  # by letter, carried out or not
    refused: int = 0  # commands answered BELL
    refused_full: int = 0  # of these, frames for which the transmit buffer had no room
    answers_dropped: int = 0  # by a fault
    frames_taken: int = 0  # from the host into the transmit buffer
    frames_sent: int = 0  # put on the bus
    frames_discarded: int = 0  # taken, then thrown away
    frames_vanished: int = 0  # frames of the host that found no room, and nobody was told
    frames_received: int = 0  # from the bus, for the host
    frames_lost: int = 0  # from the bus, no room
    frames_filtered: int = 0  # from the bus, not accepted
    frames_unseen: int = 0  # on the bus while the channel was closed
    bytes_lost: int = 0  # of lines to the host, cut out of their middle


def is_frame(letter: bytes, rest: bytes, *, fd: bool = False, remote_digits: bool = False) -> bool:
    """Whether a command for a frame has exactly the digits that it must have, and a DLC up to 8 (FD: 15)."""
    digits = ID_DIGITS[letter]
    if len(rest) <= digits or not HEX.issuperset(rest):
        return False
    dlc = int(rest[digits : digits + 1], 16)
    if dlc > (15 if fd else 8):
        return False
    length = FD_LENGTHS[dlc] if letter not in b"rR" or remote_digits else 0
    return len(rest) == digits + 1 + 2 * length


def frame_of(letter: bytes, rest: bytes) -> Frame:
    """The frame of a command that is_frame(); identifiers are cut to the bits that a controller has."""
    digits = ID_DIGITS[letter]
    remote = letter in b"rR"
    dlc = int(rest[digits : digits + 1], 16)
    data = b"" if remote else bytes.fromhex(rest[digits + 1 : digits + 1 + 2 * dlc].decode())
    extended = digits == 8
    can_id = int(rest[:digits], 16) & (0x1FFFFFFF if extended else 0x7FF)
    return Frame(can_id, extended, remote, dlc, data)


class Slcan:
    """One device; times in seconds of the caller's clock. A subclass says what its firmware does.

    `uart` for a device on a serial line, None for one on USB. `is_open`: somebody has left the channel open.
    """

    name: ClassVar[str]
    version: bytes = b""  # its answer to V; all of it
    serial_number: bytes = b""  # its answer to N

    longest: ClassVar[int] = 32  # characters of a line
    overflow: ClassVar[str] = "anew"
    """A line that is longer: "anew": begins anew with the next character; "BELL": the same, and is told;
    "last byte": is written over the last character, so that the head stays; "lost": is thrown away."""
    forgets_after_s: ClassVar[float] = math.inf  # half a line, after such a silence

    rates: ClassVar[Mapping[bytes, float]] = RATES
    transmit_room: int = 8  # frames, with the one that is being sent
    close_empties: ClassVar[bool] = True  # the transmit buffer
    remote_digits_received: ClassVar[bool] = False  # a received remote frame has 2 x DLC digits
    receive_room: ClassVar[int] = 4096  # bytes for the host

    own_faults: ClassVar[Mapping[str, OwnFault]]  # FAULTS, below

    def __init__(self, now: float = 0.0, *, uart: Uart | None = None, is_open: bool = False) -> None:
        if uart is not None:
            self.uart = uart
        self._uart = uart
        self.counters = Counters()
        self.effects: list[str] = []
        self.silent = False
        self.refusals = 0
        self.drop_answers = 0
        self.bus_off = False
        self.acknowledged = True
        self._errors = 0  # the higher of the controller's error counters
        self._flags = 0
        self._to_bus: list[Frame] = []
        self._clock = now
        self._output = bytearray()
        self._oldest_output = now
        self._last_byte_at = -math.inf
        self._buffer: list[Frame] = []
        self._sending: int | None = None  # place in the buffer
        self._done_at = math.inf
        self._boot()
        if is_open:
            self.bitrate = 125_000.0
            self.state = State.OPEN

    def _boot(self) -> None:
        """As after power-on."""
        self.powered = True
        self.state = State.CLOSED
        self.bitrate = 0.0
        self.stamp_digits = 0
        self._power_on = self._clock
        self._line = bytearray()
        self._too_long = False
        self._output.clear()
        self._empty_buffer()

    @property
    def title(self) -> str:
        return f"{self.name} ({self.version.decode()[:40]})" if self.version else self.name

    # --- what befalls it --------------------------------------------------------------------------

    def power_on(self, now: float) -> None:
        self.advance(now)
        self._boot()

    def power_off(self, now: float) -> None:
        self.advance(now)
        self.powered = False
        self._line.clear()
        self._output.clear()
        self._empty_buffer()
        if self._uart:
            self._uart.cut_off(self._clock)

    def power_cycle(self, now: float) -> None:
        self.power_off(now)
        self.power_on(now)

    def set_bus_off(self, now: float, bus_off: bool) -> None:
        """No frame leaves or comes as long as it lasts."""
        self.advance(now)
        self.bus_off = bus_off
        self._resume(now)

    def set_acknowledged(self, now: float, acknowledged: bool) -> None:
        """Without another node on its bus each frame is sent again and again, and never done with."""
        self.advance(now)
        self.acknowledged = acknowledged
        self._resume(now)

    def set_listen_only(self, now: float, listen_only: bool) -> None:
        self.advance(now)
        if self.state is not State.CLOSED:
            self.state = State.LISTEN_ONLY if listen_only else State.OPEN

    def set_error_counters(self, now: float, tec: int, rec: int) -> None:
        self.advance(now)
        self._errors = max(tec, rec)

    def garbage(self, now: float, noise: bytes) -> None:
        self.advance(now)
        self._say(now, noise)

    # --- the line -----------------------------------------------------------------------------------

    def host_writes(self, now: float, data: bytes) -> None:
        if self._uart:
            self._uart.host_writes(now, data, self._clock)
        else:
            self.advance(now)
            self._take(self._clock, data)

    def take_output(self, now: float) -> bytes:
        self.advance(now)
        if self._uart:
            return self._uart.deliver(now)
        output = bytes(self._output)
        self._output.clear()
        return output

    def _say(self, at: float, text: bytes) -> None:
        """To the host. On USB the text waits until the host reads."""
        if self.silent or not text or not self.powered:
            return
        if self._uart:
            self._uart.transmit(at, text)
            return
        if not self._output:
            self._oldest_output = at
        self._output += text

    def _take(self, at: float, data: bytes) -> None:
        if not self.powered or not self._hears(at):
            return
        if at - self._last_byte_at > self.forgets_after_s:
            self._line.clear()
        self._last_byte_at = at
        for byte in data:
            if byte == CR[0]:
                self._end_line(at)
            else:
                self._store(at, byte)

    def _hears(self, _at: float) -> bool:
        return True

    def _store(self, at: float, byte: int) -> None:
        if len(self._line) >= self.longest:
            match self.overflow:
                case "last byte":
                    self._line.pop()
                case "lost":
                    self._too_long = True
                    return
                case "BELL":
                    self._answer(at, BELL)
                    self._line.clear()
                case _:
                    self._line.clear()
        self._line.append(byte)

    def _end_line(self, at: float) -> None:
        line, too_long = bytes(self._line), self._too_long
        self._line.clear()
        self._too_long = False
        self._answer(at, self.too_long() if too_long else self._execute(at, line))

    def _answer(self, at: float, answer: bytes) -> None:
        if answer == BELL:
            self.counters.refused += 1
        if answer and self.drop_answers:
            self.drop_answers -= 1
            self.counters.answers_dropped += 1
            return
        self._say(at, answer)

    def _execute(self, at: float, line: bytes) -> bytes:
        self.counters.commands[chr(line[0]) if line else "CR"] += 1
        if not line:
            return self.lone_cr(at)
        return self.carry_out(at, line[:1], line[1:])

    # --- what a firmware says -------------------------------------------------------------------------

    def too_long(self) -> bytes:
        """Its answer to the CR of a line that was thrown away."""
        return BELL

    def lone_cr(self, _at: float) -> bytes:
        """Its answer to a CR without a command."""
        return BELL

    def carry_out(self, at: float, letter: bytes, rest: bytes) -> bytes:
        """Does what the line wants, and returns the answer."""
        raise NotImplementedError

    # --- pieces that several firmwares are made of -------------------------------------------------------

    @property
    def is_open(self) -> bool:
        return self.state is not State.CLOSED

    def open_channel(self, at: float, *, listen_only: bool = False) -> None:
        self.state = State.LISTEN_ONLY if listen_only else State.OPEN
        self._resume(at)

    def close_channel(self) -> None:
        self.state = State.CLOSED
        if self.close_empties:
            self._empty_buffer()
        else:  # whatever was being sent begins anew
            self._sending, self._done_at = None, math.inf

    def flags(self) -> bytes:
        """`Fxx` as the CAN232's manual has the bits; what was lost is forgotten."""
        flags, self._flags = self._flags, 0
        tries_in_vain = not self.acknowledged and bool(self._buffer) and self.sends()
        errors = 128 if tries_in_vain else self._errors  # ISO 11898: error-passive, and never bus-off
        flags |= WARNING_FLAG if errors >= 96 else 0
        flags |= PASSIVE_FLAG if errors >= 128 else 0
        flags |= BUS_ERROR_FLAG if self.bus_off else 0
        return b"F%02X\r" % flags

    def sends(self) -> bool:
        """Whether the controller takes part in the bus as a sender."""
        return self.state is State.OPEN and self.bitrate > 0

    # --- towards the bus ----------------------------------------------------------------------------------

    def offer(self, at: float, frame: Frame) -> bool:
        """A frame of the host into the buffer; False: there is no room, or a fault refuses the frame."""
        if self.refusals:
            self.refusals -= 1
            return False
        if len(self._buffer) >= self.transmit_room:
            self.counters.refused_full += 1
            return False
        self._put(frame)
        self.counters.frames_taken += 1
        self._resume(at)
        return True

    def _put(self, frame: Frame) -> None:
        self._buffer.append(frame)

    def _pick(self) -> int:
        """The place of the frame that the controller sends next."""
        return 0

    def _resume(self, at: float) -> None:
        """Sends the next frame, if there is one and the bus takes it."""
        if not self._buffer or not self.powered or not self.sends() or self.bus_off or not self.acknowledged:
            self._done_at = math.inf
            return
        if self._sending is None:
            self._sending = self._pick()
        if self._done_at == math.inf:
            self._done_at = at + frame_bits(self._buffer[self._sending]) / self.bitrate

    def _finish(self) -> None:
        """The frame that is being sent has been on the bus."""
        at, place = self._done_at, self._sending
        assert place is not None
        frame = self._buffer.pop(place)
        self._sending, self._done_at = None, math.inf
        self._to_bus.append(frame)
        self.counters.frames_sent += 1
        self.was_sent(at, frame)
        self._resume(at)

    def was_sent(self, at: float, frame: Frame) -> None:
        """A frame has just left the buffer for the bus."""

    def _empty_buffer(self) -> None:
        self.counters.frames_discarded += len(self._buffer)
        self._buffer.clear()
        self._sending, self._done_at = None, math.inf

    # --- from the bus -------------------------------------------------------------------------------------

    def bus_frame(self, now: float, frame: Frame) -> None:
        self.advance(now)
        if not self.powered or not self.is_open or self.bus_off:
            self.counters.frames_unseen += 1
        elif not self.passes(frame):
            self.counters.frames_filtered += 1
        else:
            self._receive(self._clock, self._line_of(frame, self._clock))

    def passes(self, _frame: Frame) -> bool:
        """Whether the acceptance filter lets a frame through."""
        return True

    def _receive(self, at: float, line: bytes) -> None:
        """A received frame, as a line for the host; without room it is lost."""
        waiting = self._uart.device_backlog if self._uart else len(self._output)
        if waiting + len(line) > self.receive_room:
            self.counters.frames_lost += 1
            self._flags |= LOST_FLAG
            return
        self.counters.frames_received += 1
        self._say(at, line)

    def _line_of(self, frame: Frame, at: float) -> bytes:
        letters = "rR" if frame.remote else "tT"
        head = f"T{frame.can_id:08X}" if frame.extended else f"t{frame.can_id:03X}"
        text = letters[frame.extended] + head[1:] + str(frame.dlc) + frame.data.hex().upper()
        if frame.remote and self.remote_digits_received:
            text += "00" * frame.dlc
        return f"{text}{self.stamp(at)}\r".encode()

    def stamp(self, at: float) -> str:
        """The time stamp of a frame that is received at `at`: ms with 4 digits, µs with 8."""
        up = at - self._power_on
        if self.stamp_digits == 8:
            return f"{int(up * 1e6) % 2**32:08X}"
        return f"{int(up * 1000) % STAMP_PERIOD_MS:04X}" if self.stamp_digits else ""

    # --- time ---------------------------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        uart = self._uart
        while True:
            arrival = uart.arrival if uart else math.inf
            due = min(self._done_at, arrival, self.timer())
            if due > now:
                break
            self._clock = max(self._clock, due)
            if self._done_at <= due:
                self._finish()
            elif uart and arrival <= due:
                self._take(self._clock, uart.take_arrived()[1])
            else:
                self.on_timer(self._clock)
        self._clock = max(self._clock, now)

    def timer(self) -> float:
        """When on_timer() has something to do."""
        return math.inf

    def on_timer(self, now: float) -> None:
        """The time of timer() has come; afterwards timer() is later."""

    def take_bus_frames(self) -> list[Frame]:
        frames, self._to_bus = self._to_bus, []
        return frames

    def next_deadline(self) -> float:
        deadline = min(self._done_at, self.timer())
        if self._uart:
            return min(deadline, self._uart.delivery, self._uart.arrival)
        return self._clock if self._output else deadline

    def report(self) -> dict[str, object]:
        return {
            "channel": self.state.value,
            "bitrate": self.bitrate,
            "counters": vars(self.counters) | {"commands": dict(self.counters.commands)},
            "buffered": len(self._buffer),
            "effects": self.effects,
        }


class Strict(Slcan):
    """Firmware that refuses a frame which has not exactly the digits it must have."""

    letters: ClassVar[bytes] = b"tTrR"
    remote_digits: ClassVar[bool] = False  # a remote frame from the host has 2 x DLC digits
    malformed: ClassVar[bytes] = BELL

    def carry_out(self, at: float, letter: bytes, rest: bytes) -> bytes:
        if letter not in ID_DIGITS:
            return self.other(at, letter, rest)
        if letter not in self.letters:
            return BELL
        fd = letter in b"dDbB"
        if not is_frame(letter, rest, fd=fd, remote_digits=self.remote_digits):
            return self.malformed
        if not self.may_send(letter, rest):
            return BELL
        if fd:
            self.effects.append(f"FD frame {(letter + rest).decode()}")
            return self.taken(letter)
        return self.taken(letter) if self.offer(at, frame_of(letter, rest)) else BELL

    def may_send(self, _letter: bytes, _rest: bytes) -> bool:
        return self.state is State.OPEN

    def taken(self, letter: bytes) -> bytes:
        """The answer to a frame that is in the buffer."""
        return CR if letter else BELL

    def other(self, at: float, letter: bytes, rest: bytes) -> bytes:
        """Whatever is no frame."""
        raise NotImplementedError


def z_or_z(letter: bytes) -> bytes:
    """The CAN232's answers to a frame with auto poll: z for a standard one, Z for an extended one."""
    return b"z\r" if letter in b"trdb" else b"Z\r"


def _acknowledge(device: Slcan, now: float, times: int) -> None:
    device.set_acknowledged(now, not times)


FAULTS: Final[Mapping[str, OwnFault]] = {
    "noack": OwnFault("no other node is on its bus to acknowledge frames", switch=_acknowledge)
}
Slcan.own_faults = FAULTS


def rates_without(*missing: int) -> Mapping[bytes, float]:
    """RATES without these digits of S."""
    return {command: rate for command, rate in RATES.items() if int(command[1:]) not in missing}


def add_arguments(parser: argparse.ArgumentParser, device: type[Slcan], *, uart: bool = False) -> None:
    """The options that all clones have: what another release of the same firmware may do otherwise."""
    from bridged.simulators.options import whole  # noqa: PLC0415 - only the command line needs them

    add = parser.add_argument
    version = device.version.decode()
    add("--version", default=version, dest="device_version", metavar="TEXT", help="answer to V")
    if device.serial_number:
        serial = device.serial_number.decode()
        add("--serial-number", default=serial, metavar="TEXT", help="answer to N, with the N")
    room = device.transmit_room
    add("--transmit-room", type=whole, default=room, metavar="FRAMES", help=f"default: {room}")
    if uart:
        add("--uart-rate", type=whole, default=None, metavar="BAUD", help="default: as fast as it goes")
    parser.set_defaults(eeprom=None, precise=False)


Kind = TypeVar("Kind", bound=Slcan)


def make(kind: type[Kind], now: float, args: argparse.Namespace, *, uart: bool = False) -> Kind:
    """The device that the options of add_arguments() ask for."""
    device = kind(now, uart=Uart(args.uart_rate) if uart else None)
    device.version = args.device_version.encode()
    device.serial_number = getattr(args, "serial_number", "").encode()
    device.transmit_room = args.transmit_room
    return device
