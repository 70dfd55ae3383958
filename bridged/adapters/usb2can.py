"""CANLAB USB2CAN: a PIC and an SJA1000 behind an FTDI FT245 ("Popis USB komunikace", chapters II and III)."""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Iterable, Mapping  # noqa: TC003 - msgspec looks at the annotations
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, NamedTuple

from msgspec import Meta

from bridged.adapters.base import (
    UNKNOWN,
    Answer,
    Exchange,
    Flow,
    Happened,
    Identity,
    Observation,
    Polling,
    PortText,
    Reply,
    Sending,
    SerialNumber,
    Steps,
    TypeName,
    pause,
)
from bridged.can import STANDARD_REGISTERS, BusState, state_of
from bridged.errors import AdapterError, WrongDeviceError
from bridged.settings import AdapterConfig, Restart

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from bridged.adapters.base import Memory
    from bridged.settings import ChannelConfig

log = logging.getLogger(__name__)

TEXT, NONE = Reply.TEXT, Reply.NONE

START = 0x0F
CONFIG_MODE, NORMAL_MODE, GET_MODE = 2, 3, 6
BUS_OFF, ERROR, ERROR_STATUS = 8, 9, 1
READ_REG, WRITE_REG, COMMAND, FW_VERSION = 16, 18, 32, 33
READ_TEC, READ_REC, READ_RST = 96, 97, 98
CRITICAL_LIMIT, READY_LIMIT, ENABLE_READ_TEC, ENABLE_READ_REC, GET = 0, 1, 2, 3, 128
BOOT, CONFIG, NORMAL = 0, 1, 2  # what GET_MODE tells
MODE_NAMES = ("BOOT", "CONFIG", "NORMAL", "LOOPBACK")

MOD, SR, IER, BTR0, BTR1, OCR, ACR0, AMR0, CDR = 0, 2, 4, 6, 7, 8, 16, 20, 31  # SJA1000, PeliCAN
RESET_MODE, LISTEN_ONLY, SINGLE_FILTER = 0x01, 0x02, 0x08  # bits of MOD
BUS_STATUS = 0x80  # bit of SR

CAPACITY = 18
"""Frames that the transmit buffer surely holds: the highest critical limit there is (COMMAND, 0)."""

ANSWER_TIMEOUT_S: Final = 0.3
MODE_TRIES = 5  # a half message of another program swallows up to 16 bytes, one try has 6
DRAIN_LOOKS = 10  # at a transmit buffer that no frame leaves, until the channel is closed all the same
DRAIN_INTERVAL_S: Final = 0.01  # between two of them; the longest frame takes 15 ms at 10 kbit/s
DRAIN_LOOKS_MAX = 40
NOISE_KEPT = 256  # bytes
FMS_SERIES, LOAD_SERIES = "7", "2"  # of the firmware: the y of HWxxxxFWyzzz

TRIPLE = re.compile(rb"\x0f[^\xef]{1,64}\xef", re.DOTALL)
"""A message of CANLAB's Triple: the same start byte, but an end byte."""


COUNTERS = bytes((START, COMMAND, 1, ENABLE_READ_TEC, START, COMMAND, 1, ENABLE_READ_REC))
"""What lets READ_TEC and READ_REC be answered."""


def message(command: int, *data: int) -> bytes:
    """One message to the device: `0F 12 02 00 01` writes 0x01 to register 0."""
    return bytes((START, command, len(data), *data))


HEALTH_REQUESTS = {
    READ_TEC: message(READ_TEC),
    READ_REC: message(READ_REC),
    READ_RST: message(READ_RST),
    READ_REG: message(READ_REG, SR),
}
HEALTH_LENGTHS = {READ_TEC: 1, READ_REC: 1, READ_RST: 2, READ_REG: 2}
"""What says how the bus is, and the lengths of the answers."""


class Levels(NamedTuple):
    """What COMMAND GET tells."""

    critical: int
    ready: int
    waiting: int  # frames in both transmit buffers


def _exchange(request: bytes, purpose: str, prefix: bytes, *, optional: bool = False) -> Exchange:
    """A request and the beginning of its answer; an `optional` one may be missing."""
    accept, reject = ((TEXT, NONE), ()) if optional else ((TEXT,), (NONE,))
    return Exchange(request, purpose, accept, reject, prefix, timeout_s=ANSWER_TIMEOUT_S)


DEFAULT_CRITICAL, DEFAULT_READY = 15, 7
"""Frames. Known to work, and with the fewest ERROR messages of the pairs that were tried on a real one."""

CriticalLimit = Annotated[int, Meta(ge=2, le=18, description="a number of frames from 2 to 18")]
# With a ready limit of 0 the adapter would never say "go on" again.
ReadyLimit = Annotated[int, Meta(ge=1, le=17, description="a number of frames from 1 to 17")]


class Usb2canConfig(AdapterConfig, frozen=True, kw_only=True):
    """A USB2CAN, and how to reach it. `port` is an absolute path, socket:// or usb://VID:PID[/SERIAL].

    With so many frames in its transmit buffer the adapter says stop (`critical_limit`) and go on
    (`ready_limit`, always below): USB2CAN document, COMMAND 0 and 1.
    """

    type: TypeName
    port: PortText
    serial_number: SerialNumber | None = None
    critical_limit: CriticalLimit = DEFAULT_CRITICAL
    ready_limit: ReadyLimit = DEFAULT_READY

    default_window: ClassVar[int] = 16
    default_restart = Restart.ITSELF
    bitrates = STANDARD_REGISTERS.keys()
    identified_by_usb: ClassVar[bool] = True  # no command tells its serial number
    schemes: ClassVar[tuple[str, ...]] = ("socket", "usb", "usb-serial")
    refused_schemes: ClassVar[Mapping[str, str]] = {
        "rfc2217": "rfc2217:// sets the baud rate of a serial line, and a USB2CAN has none; write socket://"
    }
    refused_keys: ClassVar[Mapping[str, str]] = {
        "baudrate": "a USB2CAN has no baud rate, there is no serial line in it: remove it"
    }

    @classmethod
    def problems(cls, values: Mapping[str, Any], given: Collection[str]) -> Iterable[tuple[str, str]]:
        """Limits that would have the adapter say go on before it says stop."""
        limits = [key for key in ("critical_limit", "ready_limit") if key in given]
        if any(key not in values for key in limits):  # reported already
            return
        critical = values.get("critical_limit", DEFAULT_CRITICAL)
        ready = values.get("ready_limit", DEFAULT_READY)
        if ready < critical:
            return
        default = ", its default" if len(limits) == 1 else ""
        if "ready_limit" in limits:
            text = f"expected a limit below critical_limit ({critical}{default}), got {ready}"
        else:
            text = f"expected a limit above ready_limit ({ready}{default}), got {critical}"
        yield limits[-1], text

    @property
    def usb_serial_number(self) -> str | None:
        return self.serial_number


SETTINGS = Usb2canConfig


def make_adapter(settings: Usb2canConfig, channel: ChannelConfig, memory: Memory) -> Usb2can:  # noqa: ARG001
    return Usb2can(settings, channel)


class Usb2can:
    """Sans-I/O: what to say to a USB2CAN. `identity` and `flow` hold what init_steps found out."""

    codec = "usb2can"
    sending = Sending()
    sent_means = "sent means taken by the adapter, by what it answers about the level of its buffer"
    cautions: tuple[str, ...] = ()
    tells_full = True
    stops = True
    baudrate = 115_200  # of no meaning to a FT245, but a tty wants one
    answer_timeout_s = ANSWER_TIMEOUT_S
    polling: Polling | None = None
    last_words = message(CONFIG_MODE) + message(WRITE_REG, MOD, RESET_MODE)

    def __init__(self, adapter: Usb2canConfig, channel: ChannelConfig) -> None:
        self._port = adapter.port
        self._wanted_serial = adapter.serial_number
        self._critical = adapter.critical_limit
        self._ready = adapter.ready_limit
        self._channel = channel
        self._noise = bytearray()
        self._levels_prefix: bytes | None = None  # how this firmware begins its answer to COMMAND GET
        self._health: dict[int, Exchange] = {}  # command and what is asked to know how the bus is
        self.discarded = 0
        self._restarts: bytes | None = None  # as READ_RST tells them: in which byte order is not said
        self._mode_exchange = _exchange(
            message(GET_MODE), "tell its mode", bytes((GET_MODE, 1)), optional=True
        )
        self.identity = Identity()
        self.flow: Flow | None = None
        # Mode NORMAL is part of the answer: after a reset the device would answer, but take no frames.
        self.sync = _exchange(message(GET_MODE), "tell its mode", bytes((GET_MODE, 1, NORMAL)))

    # --- start and end ------------------------------------------------------------------------

    def init_steps(self, serial_number: str | None, product: str | None = None) -> Steps:  # noqa: ARG002
        """The ten steps of chapter III; GET_MODE confirms a mode change, which nothing acknowledges."""
        self.flow = None
        self._noise.clear()
        self._check_serial_number(serial_number)
        yield from self._enter_config_mode()
        yield from self._identify(serial_number)
        yield from self._configure()
        levels = yield from self._set_limits()
        yield from self._enter_normal_mode()
        yield from self._find_health()
        yield from self._start_controller()
        if levels:
            assert self._levels_prefix is not None
            ask, prefix = message(COMMAND, GET), self._levels_prefix
        else:
            log.info(
                "firmware does not tell how full its transmit buffer is: fewer frames are sent at a time"
            )
            ask, prefix = message(READ_REG, MOD), bytes((READ_REG, 2, MOD))
        self.flow = Flow(ask, prefix, CAPACITY, self._critical, self._ready)

    def close_steps(self, drain: bool) -> Steps:
        """CONFIG_MODE and reset mode (chapter III); to drain is to wait for what goes on the bus at all."""
        if self.flow and self._levels_prefix:
            yield from self._drain(DRAIN_LOOKS_MAX if drain else 1)
        self.flow = None
        for _ in range(2):
            answer = yield self._in_config_mode(message(CONFIG_MODE))
            if answer.reply is TEXT:
                break
        yield _exchange(
            message(WRITE_REG, MOD, RESET_MODE),
            "take its controller off the bus",
            bytes((WRITE_REG, 1, MOD)),
            optional=True,
        )

    def _drain(self, looks_max: int) -> Steps:
        """Waits while frames leave its transmit buffer, and counts those that stay."""
        fewest, looks = 255, DRAIN_LOOKS
        for look in range(looks_max):
            if look:
                yield pause(DRAIN_INTERVAL_S)
            levels = yield from self._read_levels()
            if levels is None or not levels.waiting:
                return
            looks = DRAIN_LOOKS if levels.waiting < fewest else looks - 1
            fewest = min(fewest, levels.waiting)
            if not looks:
                break
        self.discarded += fewest

    def _in_config_mode(self, request: bytes) -> Exchange:
        """A request that nothing acknowledges, and GET_MODE, whose answer comes when it is done."""
        return _exchange(
            request + message(GET_MODE), "enter mode CONFIG", bytes((GET_MODE, 1, CONFIG)), optional=True
        )

    def _enter_config_mode(self) -> Steps:
        for _ in range(MODE_TRIES):
            answer = yield self._in_config_mode(message(CONFIG_MODE))
            if answer.reply is TEXT:
                return
        if TRIPLE.search(self._noise):
            msg = f"the device on {self._port} is a CANLAB Triple: its protocol is not that of the USB2CAN"
            raise WrongDeviceError(msg)
        heard = f"; it sent {len(self._noise)} bytes that are no USB2CAN messages" if self._noise else ""
        msg = (
            f"no answer to CONFIG_MODE and GET_MODE on {self._port}{heard}: is it the USB2CAN, and not "
            f"another device with an FTDI chip? If it is, unplug it and plug it in again"
        )
        raise AdapterError(msg)

    def _enter_normal_mode(self) -> Steps:
        """NORMAL_MODE is not for mode NORMAL (the table in chapter II): again only if it was not obeyed."""
        request = message(NORMAL_MODE)
        for _ in range(MODE_TRIES):
            answer = yield _exchange(
                request + message(GET_MODE), "enter mode NORMAL", bytes((GET_MODE, 1)), optional=True
            )
            if answer.reply is NONE:  # it may be lost
                request = b""
            elif answer.text[2] == NORMAL:
                return
            else:
                request = message(NORMAL_MODE)
        msg = f"the adapter on {self._port} does not enter mode NORMAL"
        raise AdapterError(msg)

    # --- who it is ----------------------------------------------------------------------------

    def _check_serial_number(self, serial_number: str | None) -> None:
        if self._wanted_serial is None or serial_number == self._wanted_serial:
            return
        has = (
            f"has serial number {serial_number}" if serial_number else "has no serial number that can be read"
        )
        msg = f"the USB device behind {self._port} {has}, adapter.serial_number wants {self._wanted_serial}"
        raise WrongDeviceError(msg)

    def _identify(self, serial_number: str | None) -> Steps:
        answer = yield _exchange(message(FW_VERSION), "tell its version", bytes((FW_VERSION, 12)))
        version = answer.text[2:].decode("ascii", "replace")
        parts = re.fullmatch(r"HW(\w{4})FW(\w)(\w{3})", version)
        if not parts:
            msg = f"the device on {self._port} answers FW_VERSION with {version!r}, not HWxxxxFWyzzz"
            raise WrongDeviceError(msg)
        self.identity = Identity(version, serial_number)
        series = parts[2]
        if series == FMS_SERIES:
            msg = f"the device on {self._port} has FMS firmware ({version}), which makes it no CAN adapter"
            raise WrongDeviceError(msg)
        if series == LOAD_SERIES:
            log.warning("adapter has firmware that loads the bus for tests (%s)", version)

    # --- settings -----------------------------------------------------------------------------

    def _write(self, name: str, address: int, value: int) -> Generator[Exchange, Answer, None]:
        yield _exchange(
            message(WRITE_REG, address, value),
            f"write {value:#04x} to register {name} ({address})",
            bytes((WRITE_REG, 1, address)),
        )

    @property
    def _mode_bits(self) -> int:
        """MOD as it is to be on the bus. Without a filter the mode is dual, as in the document."""
        acceptance = self._channel.acceptance
        return LISTEN_ONLY * self._channel.listen_only | SINGLE_FILTER * bool(
            acceptance and acceptance.single
        )

    def _configure(self) -> Steps:
        """Steps 2 to 7."""
        acceptance = self._channel.acceptance
        code, mask = (acceptance.code, acceptance.mask) if acceptance else (0, 0xFFFFFFFF)
        btr0, btr1 = self._channel.timing.register_pair
        yield from self._write("MOD", MOD, RESET_MODE)
        if self._mode_bits:
            # They can be changed in reset mode only: should NORMAL_MODE end it, they must be there already.
            yield from self._write("MOD", MOD, RESET_MODE | self._mode_bits)
        yield from self._write("CDR", CDR, 0xC0)
        for i, value in enumerate(code.to_bytes(4, "big")):
            yield from self._write(f"ACR{i}", ACR0 + i, value)
        for i, value in enumerate(mask.to_bytes(4, "big")):
            yield from self._write(f"AMR{i}", AMR0 + i, value)
        yield from self._write("OCR", OCR, 0xDA)
        yield from self._write("IER", IER, 0x03)
        yield from self._write("BTR0", BTR0, btr0)
        yield from self._write("BTR1", BTR1, btr1)

    def _set_limits(self) -> Generator[Exchange, Answer, bool]:
        """Step 8, so that ready < critical holds at every moment, whatever the limits were.

        Whether COMMAND GET tells how full the transmit buffer is: not said how in the document, so it is
        believed only if it repeats the limits, and an idle buffer is empty.
        """
        limits = message(COMMAND, CRITICAL_LIMIT, self._critical) + message(COMMAND, READY_LIMIT, self._ready)
        before = yield from self._find_levels()
        if before is None or before.ready >= self._critical:
            limits = message(COMMAND, READY_LIMIT, 0) + limits  # 0 is below any critical limit
        answer = yield self._in_config_mode(limits + COUNTERS)
        if answer.reply is NONE:
            msg = f"the adapter on {self._port} stopped answering when its limits were set"
            raise AdapterError(msg)
        if before is None:
            return False
        after = yield from self._read_levels()
        if after == Levels(self._critical, self._ready, 0):
            return True
        self._levels_prefix = None  # what it tells are not levels
        return False

    def _find_levels(self) -> Generator[Exchange, Answer, Levels | None]:
        """COMMAND GET, whose answer begins with its code or does not."""
        for prefix in (bytes((COMMAND, 5, GET)), bytes((COMMAND, 4))):
            self._levels_prefix = prefix
            levels = yield from self._read_levels()
            if levels:
                return levels
        self._levels_prefix = None
        return None

    def _read_levels(self) -> Generator[Exchange, Answer, Levels | None]:
        assert self._levels_prefix is not None
        answer = yield _exchange(message(COMMAND, GET), "tell its limits", self._levels_prefix, optional=True)
        if answer.reply is NONE:
            return None
        critical, ready, first, second = answer.text[-4:]
        return Levels(critical, ready, first + second)

    def _start_controller(self) -> Steps:
        """Step 10. A listener that acknowledges, or a filter of the other kind, must not go unnoticed."""
        bits = self._mode_bits
        for step in self._write("MOD", MOD, bits):
            yield step._replace(opens=True)
        if not bits:
            return
        answer = yield _exchange(message(READ_REG, MOD), "tell register MOD", bytes((READ_REG, 2, MOD)))
        if answer.text[-1] & (LISTEN_ONLY | SINGLE_FILTER) != bits:
            found = f"MOD is {answer.text[-1]:#04x}, not {bits:#04x}"
            msg = f"the adapter on {self._port} does not keep its listen-only or filter mode: {found}"
            raise WrongDeviceError(msg)

    # --- health -------------------------------------------------------------------------------

    def _find_health(self) -> Steps:
        """Which of the questions about the bus this firmware answers."""
        self._health = {}
        answer = Answer(NONE)
        for command, request in HEALTH_REQUESTS.items():
            exchange = _exchange(
                request, "tell how its bus is", bytes((command, HEALTH_LENGTHS[command])), optional=True
            )
            answer = yield exchange
            if answer.reply is TEXT:
                self._health[command] = exchange
            if command == READ_RST:
                self._restarts = answer.text[2:]

    def health_questions(self) -> tuple[Exchange, ...]:
        """Its mode, error counters, restarts after bus-off, and whether it is bus-off now."""
        return self._mode_exchange, *self._health.values()

    def read_health(self, answers: Sequence[Answer | None]) -> Observation | None:
        mode = answers[0]
        if mode and mode.reply is TEXT and mode.text[2] != NORMAL:
            raise AdapterError(_wrong_mode(mode.text[2]))
        if None in answers:
            return None
        texts = [answer.text[2:] for answer in answers if answer]
        if not all(texts):
            return UNKNOWN
        told = dict(zip(self._health, texts[1:], strict=True))
        restarted = told.get(READ_RST) != self._restarts
        self._restarts = told.get(READ_RST)
        tec, rec = told.get(READ_TEC), told.get(READ_REC)
        status = told.get(READ_REG)
        bus_off = bool(status and status[-1] & BUS_STATUS)
        return _observation(
            "bus-off" if bus_off else "bus good",
            bus_off=bus_off,
            tec=tec[0] if tec else None,
            rec=rec[0] if rec else None,
            happened=Happened.RESTARTED if restarted else Happened.NOTHING,
        )

    def read_report(self, text: bytes) -> Observation | None:
        """BUS_OFF, ERROR STATUS, and a mode that a running device must not have."""
        if text[0] == BUS_OFF:
            return _observation("bus-off, it restarts by itself", bus_off=True, tec=text[6], rec=text[5])
        if text[0] == ERROR and text[2] == ERROR_STATUS:
            # Bytes 1 to 5 are those of BUS_OFF, and in the same places.
            shift = text[1] - 6  # all of BUS_OFF's bytes follow, where there is one more
            crossed = "error counters crossed the warning limit"
            return _observation(crossed, tec=text[6 + shift], rec=text[5 + shift])
        if text[0] == GET_MODE and self.flow and text[2] != NORMAL:
            raise AdapterError(_wrong_mode(text[2]))
        return None

    def saw_time_stamps(self) -> None:
        """Firmware of series 5 and 6 has them, and sends them always."""

    def saw_noise(self, noise: bytes) -> None:
        self._noise += noise[: NOISE_KEPT - len(self._noise)]

    def saw_text(self, text: bytes) -> None:
        """A report of the time before: whoever speaks its protocol answers what it is asked."""


def _wrong_mode(mode: int) -> str:
    return f"the adapter is in mode {MODE_NAMES[mode]}: it was reset, or another program uses it"


def _observation(
    text: str,
    *,
    bus_off: bool = False,
    tec: int | None,
    rec: int | None,
    happened: Happened = Happened.NOTHING,
) -> Observation:
    counted = tec is not None and rec is not None
    state = (
        BusState.BUS_OFF if bus_off else state_of(tec, rec) if tec is not None and rec is not None else None
    )
    counters = f" (TEC={tec} REC={rec})" if counted else ""
    return Observation(text + counters, state, tec=tec, rec=rec, happened=happened)
