"""What the firmware of the simulated USB2CAN makes of one command, and how it puts frames on the bus.

Where the manual leaves it open, usb2can.py says what was decided.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, deque
from typing import TYPE_CHECKING

from bridged.simulators.sja1000 import (
    ALC,
    BTR0,
    BTR1,
    CDR,
    CDR_PELICAN,
    ECC,
    MOD,
    MOD_RESET,
    REGISTER_NAMES,
    RESET_MODE_ONLY,
    RXERR,
    SR,
    TXERR,
    Frame,
    Sja1000,
    frame_bits,
)
from bridged.simulators.usb2can_messages import (
    BUS_OFF,
    CAN_TRANSMIT,
    CMD_BASIC,
    CMD_BAUD_RATE,
    CMD_CRITICAL,
    CMD_GET,
    CMD_LENGTHS,
    CMD_READY,
    COMMAND,
    CRITICAL_TRANSMIT,
    ERROR,
    GO,
    LIMIT,
    MODE_NUMBERS,
    READ_MESSAGE,
    READ_MESSAGE_TS,
    RULES,
    RX_OVERRUN,
    STOP,
    WRITE_MESSAGE,
    Setup,
    State,
    Variant,
    describe,
    frame_in_transmit_buffer,
    message,
    receive_buffer_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable

CRITICAL_MAX = 18  # and 17 for the ready limit, which is less
LIMITS_REPEAT_S = 0.1
FRAME_BYTES_MAX = 13
STAMPS_PER_S = 4000
ROUNDING = 1e-6  # 0.001 * 4000 is less than 4 in some sums
ACCEPT_ALL = b"\xff\xff\xff\xff"
CONFIG_QUIRK = b"\xff\xff"
RECORD_LENGTH = 200
VIOLATIONS_KEPT = 1000  # all are counted


@dataclasses.dataclass
class Counters:
    """What happened since the simulator began; `frames_taken` = sent + discarded + still waiting."""

    commands: Counter[str] = dataclasses.field(default_factory=Counter)  # by name, carried out or not
    bytes_skipped: int = 0  # from the host, outside of messages
    host_lost: int = 0  # bytes from the host while there was no power
    answers_dropped: int = 0  # by a fault: carried out, but the host did not hear of it
    frames_taken: int = 0  # from the host into the transmit buffer
    frames_sent: int = 0  # put on the bus
    frames_discarded: int = 0  # in the transmit buffer when NORMAL mode was left
    frames_bounced: int = 0  # from the host, handed back with ERROR_CAN_TRANSMIT
    frames_echoed: int = 0  # from the host, in LOOPBACK mode
    frames_received: int = 0  # from the bus into the buffer towards USB
    frames_lost: int = 0  # from the bus, that buffer full
    frames_filtered: int = 0  # from the bus, not accepted
    frames_unseen: int = 0  # on the bus while the chip was not
    stops: int = 0  # ERROR_CRITICAL_TRANSMIT 1
    gos: int = 0  # ERROR_CRITICAL_TRANSMIT 0, those lost by a fault included
    gos_lost: int = 0
    overruns: int = 0  # ERROR_RX_OVERRUN
    violations: int = 0


class _Breach(Exception):  # noqa: N818  what the host did, not what went wrong here
    """The host broke a rule of the manual, and the device does nothing."""


class Firmware:
    """Modes, commands, the chip, the transmit buffer; `_output` is what goes to the host.

    A subclass moves `_clock`, does what is due at `_head_done`, `_tick` and `_repeat`, and reads `_output`.
    """

    def __init__(self, now: float, variant: Variant) -> None:
        self.variant = variant
        self.counters = Counters()
        self.violations: list[str] = []
        self.silent = False
        self.refusals = 0
        self.drop_answers = 0
        self.lose_go = 0
        self.bus_off = False
        self.powered = True
        self._capacity = variant.capacity
        self._has_stamps = variant.has_stamps
        self._record: deque[str] = deque(maxlen=RECORD_LENGTH)
        self._to_bus: list[Frame] = []
        self._output: list[bytes] = []
        self._fifo: deque[Frame] = deque()  # from the host, to the bus
        self._head_done = math.inf  # when the first of these is on the bus
        self._clock = self._power_on = now
        self._unaware = False  # the host does not know of a power failure, or in which mode this is

    @property
    def waiting(self) -> int:
        """Frames in the transmit buffer."""
        return len(self._fifo)

    def _boot(self) -> None:
        """The firmware begins anew."""
        self._discard_frames()
        self.state = State.BOOT
        self.chip = Sja1000()
        self.critical = self.ready = 0
        self.restarts = 0  # of the chip after bus-off
        self._limits_set: set[int] = set()
        self._reads_tec = self._reads_rec = False
        self._bus_off_told = False
        self._setup = Setup()
        self._tick = self._repeat = math.inf  # next TIMESTAMP, next CRITICAL_TRANSMIT 2
        self._update()

    def _execute(self, command: int, data: bytes) -> None:
        """Carry out one command, and send its answer if it has one."""
        rule = RULES[command]
        self.counters.commands[rule.name] += 1
        if self.state not in rule.modes:
            if not self._unaware:
                self._violate(f"{describe(command, data)}: in {self.state.name} mode")
            return
        if len(data) not in rule.lengths:
            self._violate(f"{describe(command, data)}: {len(data)} data bytes")
            return
        try:
            answer = _CARRY_OUT.get(command, Firmware._not_there)(self, data)
        except _Breach as breach:
            self._violate(f"{describe(command, data)}: {breach}")
            return
        if command != WRITE_MESSAGE:
            self._record.append(describe(command, data))
        if answer is not None:
            if self.drop_answers:
                self.drop_answers -= 1
                self.counters.answers_dropped += 1
            else:
                self._emit_message(command, answer)

    def _violate(self, text: str) -> None:
        self.counters.violations += 1
        if len(self.violations) < VIOLATIONS_KEPT:
            self.violations.append(text)

    def _emit_message(self, command: int, data: bytes) -> None:
        self._emit(message(command, data))

    def _emit(self, output: bytes) -> None:
        if self.powered and not self.silent:
            self._output.append(output)

    # The bus

    def _on_bus(self) -> bool:
        chip = self.chip
        return self.powered and self.state is State.NORMAL and not chip.in_reset and chip.pelican

    def _update(self) -> None:
        """After anything that decides whether frames flow and which events repeat."""
        chip = self.chip
        on_bus = self._on_bus()
        self._receiving = on_bus and not self.bus_off
        self._sending = self._receiving and not chip.listen_only
        if not self._sending:
            self._head_done = math.inf  # a frame on its way is repeated
            chip.transmitting = False
        elif self._head_done == math.inf:
            self._start_sending(self._clock)
        if self._bus_off_told != (on_bus and self.bus_off):
            self._bus_off_told = not self._bus_off_told
            chip.set_bus_off(self._bus_off_told)
            if self._bus_off_told:
                self.restarts = (self.restarts + 1) & 0xFFFF
                self._emit_message(BUS_OFF, self._bus_state())
        normal = self.powered and self.state is State.NORMAL
        if not (normal and self._has_stamps):
            self._tick = math.inf
        elif self._tick == math.inf:
            self._tick = self._power_on + math.floor(self._clock - self._power_on) + 1
        if not normal or self._limits_usable():
            self._repeat = math.inf
        elif self._repeat == math.inf:
            self._repeat = self._clock

    def _bus_state(self) -> bytes:
        """The data of BUS_OFF."""
        read = self.chip.read
        return bytes(map(read, (SR, ALC, ECC, RXERR, TXERR, SR)))

    def _start_sending(self, at: float) -> None:
        chip = self.chip
        if self._fifo and self._sending:
            self._head_done = at + frame_bits(self._fifo[0]) / chip.bitrate
            chip.transmitting = True
        else:
            self._head_done = math.inf
            chip.transmitting = False

    def _frame_sent(self, at: float) -> None:
        """The first frame of the transmit buffer is on the bus."""
        self._to_bus.append(self._fifo.popleft())
        self.counters.frames_sent += 1
        self._allow()
        self._start_sending(at)

    def _allow(self) -> None:
        """GO, if it is time."""
        if self._stopped and len(self._fifo) < self.ready:
            self._forget_stop()
            self.counters.gos += 1
            if self.lose_go:
                self.lose_go -= 1
                self.counters.gos_lost += 1
            else:
                self._emit_message(ERROR, bytes((CRITICAL_TRANSMIT, GO)))

    def _forget_stop(self) -> None:
        self._stopped = False
        self._stop_pending = False  # said, but not yet given to the host
        self._stop_limit = math.inf  # until when the host may send

    def _discard_frames(self) -> None:
        self.counters.frames_discarded += len(self._fifo)
        self._fifo.clear()
        self._head_done = math.inf
        self._forget_stop()

    def _received_message(self, frame: Frame) -> bytes:
        """READ_MESSAGE or READ_MESSAGE_TS, now."""
        data = receive_buffer_of(frame)
        if not self._has_stamps:
            return message(READ_MESSAGE, data)
        stamp = int((self._clock - (self._tick - 1)) * STAMPS_PER_S + ROUNDING)
        stamp = min(max(stamp, 0), STAMPS_PER_S - 1)
        return message(READ_MESSAGE_TS, data + stamp.to_bytes(2, self.variant.stamp_order))

    def _tell_overrun(self) -> None:
        self.counters.overruns += 1
        self._emit_message(ERROR, bytes((RX_OVERRUN,)))

    def _limits_usable(self) -> bool:
        return self.ready < self.critical <= CRITICAL_MAX

    # Commands; they return the data of the answer, or None if there is none

    def _echo(self, data: bytes) -> bytes:
        return data

    def _change_mode(self, state: State) -> None:
        if self.state is State.NORMAL:
            self._discard_frames()
        self.state = state
        self._update()

    def _boot_mode(self, _data: bytes) -> None:
        self._violate("BOOT_MODE: it serves to flash the firmware only")
        self._boot()

    def _config_mode(self, _data: bytes) -> None:
        self._unaware = False
        self._setup = Setup()
        self._change_mode(State.CONFIG)
        if self.variant.quirks:
            self._emit(CONFIG_QUIRK)

    def _normal_mode(self, _data: bytes) -> None:
        missing = self._setup.missing()
        if missing:
            self._violate(f"NORMAL_MODE: {missing}")
        self._change_mode(State.NORMAL)

    def _loopback_mode(self, _data: bytes) -> None:
        self._change_mode(State.LOOPBACK)

    def _get_mode(self, _data: bytes) -> bytes:
        return bytes((MODE_NUMBERS[self.state],))

    def _read_reg(self, data: bytes) -> bytes:
        return data + bytes((self.chip.read(data[0]),))

    def _write_reg(self, data: bytes) -> bytes:
        self._write(data[0], data[1])
        return data[:1]

    def _write_read_reg(self, data: bytes) -> bytes:
        self._write(data[0], data[1])
        return bytes((data[0], self.chip.read(data[0])))

    def _bitmod_reg(self, data: bytes) -> bytes:
        address, mask, value = data
        self._write(address, self.chip.read(address) & ~mask | value & mask)
        return data

    def _bitmod_read_reg(self, data: bytes) -> bytes:
        return self._bitmod_reg(data) + bytes((self.chip.read(data[0]),))

    def _write(self, address: int, value: int) -> None:
        """Write a register of the chip on the host's behalf, watching what it writes."""
        chip = self.chip
        in_reset = chip.in_reset
        name = REGISTER_NAMES.get(address, f"register {address}")
        what = f"{name} = 0x{value:02X}"
        taken = chip.write(address, value)
        if not taken:
            reason = "cannot be written" if in_reset else "not outside of the chip's reset mode"
            self._violate(f"{what}: {reason}")
        elif self.state is not State.CONFIG and address in _CONFIG_ONLY:
            self._violate(f"{what}: in {self.state.name} mode")
        if self.state is State.CONFIG:
            self._setup.did(address, value)
        self._update()

    def _command(self, data: bytes) -> bytes | None:
        code = data[0]
        if code not in CMD_LENGTHS:
            raise _Breach("unknown")
        if len(data) != CMD_LENGTHS[code]:
            raise _Breach(f"{len(data)} data bytes")
        if CMD_BASIC <= code <= CMD_BAUD_RATE and self.state is not State.CONFIG:
            raise _Breach(f"in {self.state.name} mode")
        chip = self.chip
        match code:
            case 0 | 1:
                self._set_limit(code, data[1])
            case 2:
                self._reads_tec = True
            case 3:
                self._reads_rec = True
            case 4:
                self._write(CDR, chip.read(CDR) & ~CDR_PELICAN)
            case 5:
                self._write(CDR, chip.read(CDR) | CDR_PELICAN)
            case 6:
                self._write(MOD, chip.read(MOD) | MOD_RESET)
            case 7:
                self._write(MOD, chip.read(MOD) & ~MOD_RESET)
            case 8:
                self._write(BTR0, data[1])
                self._write(BTR1, data[2])
            case _:
                return self._get() if self.variant.answers_get else None
        return None

    def _get(self) -> bytes:
        first = min(self.waiting, self.variant.tx_buffer)
        values = bytes((self.critical, self.ready, first, self.waiting - first))
        return values if self.variant.get_length_4 else bytes((CMD_GET,)) + values

    def _set_limit(self, code: int, value: int) -> None:
        """A limit that the host has not set yet is unknown to it, and cannot contradict the other."""
        if code == CMD_CRITICAL:
            self.critical = value
        else:
            self.ready = value
        limits_set = self._limits_set
        limits_set.add(code)
        critical = self.critical if CMD_CRITICAL in limits_set else CRITICAL_MAX
        ready = self.ready if CMD_READY in limits_set else 0
        if not ready < critical <= CRITICAL_MAX:
            self._violate(f"limits: critical {critical}, ready {ready}")
        if self.state is State.CONFIG:
            self._setup.did(LIMIT + code, value)
        if not self._limits_usable():
            self._forget_stop()
        self._allow()
        self._update()

    def _fw_version(self, _data: bytes) -> bytes:
        return self.variant.version.encode()

    def _write_message(self, data: bytes) -> None:
        frame = frame_in_transmit_buffer(data)
        if frame is None:
            raise _Breach("the length does not fit the frame information")
        counters = self.counters
        if self.state is State.LOOPBACK:
            counters.frames_echoed += 1
            self._emit_message(READ_MESSAGE, data)
            return
        if self.chip.in_reset:
            self._violate("WRITE_MESSAGE: the chip is in reset mode (III.10)")
        elif self.chip.listen_only and not self._unaware:
            self._violate("WRITE_MESSAGE: the chip is in listen-only mode")
        fifo = self._fifo
        if self.refusals or len(fifo) >= self._capacity:
            self.refusals = max(0, self.refusals - 1)
            counters.frames_bounced += 1
            bounced = data.ljust(FRAME_BYTES_MAX, b"\0") if self.variant.padded else data
            self._emit_message(ERROR, bytes((CAN_TRANSMIT,)) + bounced)
            return
        fifo.append(frame)
        counters.frames_taken += 1
        if len(fifo) == 1:
            self._start_sending(self._clock)
        if len(fifo) > self.critical and not self._stopped and self._limits_usable():
            self._stopped = True
            counters.stops += 1
            self._stop_pending = not self.silent
            self._emit_message(ERROR, bytes((CRITICAL_TRANSMIT, STOP)))

    def _read_tec(self, _data: bytes) -> bytes:
        if not self._reads_tec:
            raise _Breach("not enabled")
        return bytes((self.chip.tec,))

    def _read_rec(self, _data: bytes) -> bytes:
        if not self._reads_rec:
            raise _Breach("not enabled")
        return bytes((self.chip.rec,))

    def _read_rst(self, _data: bytes) -> bytes:
        return self.restarts.to_bytes(2, "little")

    def _not_there(self, _data: bytes) -> None:
        raise _Breach("this device does not have it")

    def _never(self, _data: bytes) -> None:
        raise _Breach("writes the firmware")


# Set up in CONFIG mode only; of MOD, step III.10 writes it in NORMAL mode
_CONFIG_ONLY = RESET_MODE_ONLY | {CDR}

_CARRY_OUT: dict[int, Callable[[Firmware, bytes], bytes | None]] = {
    0: Firmware._echo,
    1: Firmware._boot_mode,
    2: Firmware._config_mode,
    3: Firmware._normal_mode,
    4: Firmware._loopback_mode,
    6: Firmware._get_mode,
    16: Firmware._read_reg,
    18: Firmware._write_reg,
    20: Firmware._write_read_reg,
    21: Firmware._bitmod_reg,
    22: Firmware._bitmod_read_reg,
    COMMAND: Firmware._command,
    33: Firmware._fw_version,
    WRITE_MESSAGE: Firmware._write_message,
    96: Firmware._read_tec,
    97: Firmware._read_rec,
    98: Firmware._read_rst,
    127: Firmware._never,
}
