"""LAWICEL CAN232 and devices that speak its ASCII protocol (CAN232 manual, version 3).

What is particular to a firmware is in its profile (adapters/firmware), which recognition.py chooses.
"""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Mapping  # noqa: TC003 - msgspec looks at the annotations
from typing import TYPE_CHECKING, Annotated, ClassVar

from msgspec import Meta

from bridged.adapters import firmware
from bridged.adapters.base import (
    UNKNOWN,
    Answer,
    Baudrate,
    Confirms,
    Exchange,
    Flow,
    Happened,
    Identity,
    Memory,
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
from bridged.adapters.can232_eeprom import Eeprom, may_be_stored
from bridged.adapters.firmware.profile import BITRATES, Command
from bridged.adapters.recognition import ANYTHING, Recognition, question
from bridged.can import STANDARD_REGISTERS, BusState
from bridged.errors import AdapterError, WrongDeviceError
from bridged.settings import AdapterConfig, After

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from bridged.adapters.firmware.profile import Profile
    from bridged.can import BitTiming
    from bridged.settings import ChannelConfig, TransmitConfig

log = logging.getLogger(__name__)

OK, REFUSED, TEXT, NONE = Reply.OK, Reply.REFUSED, Reply.TEXT, Reply.NONE

LONGEST_LINE = 27  # "T1FFFFFFF81122334455667788\r"
RECEIVE_FIFO = 32  # frames that may be on their way out before an answer (manual 1.3)
POLL_INTERVAL_S = 0.01
COMMANDS_MAX = 2  # that the buffer of its serial line holds (manual)
LONGEST_FRAME_BITS = 160  # extended, 8 bytes, as many stuff bits as there can be, the pause behind it
DRAIN_LONGEST_S = 1.0
SILENT_STEP_S = 0.02  # for a command that is never answered

# F, CAN232 manual: bit -> meaning. Bit 4 is not used.
STATUS_FLAGS = {
    0: "receive FIFO full",
    1: "transmit FIFO full",
    2: "error warning",
    3: "data overrun",
    5: "error passive",
    6: "arbitration lost",
    7: "bus error",
}
STATES = {2: BusState.ERROR_WARNING, 5: BusState.ERROR_PASSIVE}
HAPPENED = {
    0: Happened.RX_OVERFLOW,
    1: Happened.TX_FULL,
    3: Happened.RX_OVERFLOW,
    6: Happened.ARBITRATION_LOST,
    7: Happened.BUS_ERROR,
}
# Of a firmware without such flags.
ANSWERS = Observation("it answers; how its bus is, its firmware does not tell")
LOCKED = Observation(
    "it refuses every question: its buffer is full, since nobody acknowledges its frames",
    happened=Happened.TX_FULL,
)

SENT_MEANS = {
    Confirms.TAKEN: "sent means taken into the adapter's transmit buffer, which closing empties",
    Confirms.SENT: "sent means that the frame was on the CAN bus",
    Confirms.QUEUED: "sent means taken into the adapter's buffer: what becomes of it, it does not tell",
    Confirms.ALWAYS: "this firmware confirms also frames that it loses: sent means written to the adapter",
    Confirms.NOTHING: "this firmware does not confirm frames: sent means written to USB",
}
ORDER_UNCERTAIN = "; where other nodes keep the bus busy, frames may leave it in another order"

Firmware = Annotated[
    str, Meta(pattern=f"^({'|'.join(firmware.NAMES)})$", description=" or ".join(firmware.NAMES))
]


class Can232Config(AdapterConfig, frozen=True, kw_only=True):
    """A CAN232, and how to reach it. `port` is an absolute path or a pyserial URL; `baudrate` in bit/s.

    `firmware` names the profile of what is there; None: it has to say by its answers what it is.
    """

    type: TypeName
    port: PortText
    baudrate: Baudrate = 57_600
    serial_number: SerialNumber | None = None  # of the CAN232 itself, which the USB device has not
    firmware: Firmware | None = None

    default_window: ClassVar[int] = 1
    default_restart = After(0.1)
    bitrates = BITRATES.keys()
    schemes: ClassVar[tuple[str, ...]] = ("socket", "rfc2217", "usb-serial")
    refused_schemes: ClassVar[Mapping[str, str]] = {
        "usb": "usb:// goes with type: usb2can; a CAN232 is on a serial line, such as /dev/ttyUSB0"
    }
    other_names: ClassVar[tuple[str, ...]] = ("slcan", "slcand", "lawicel")
    other_names_advice: ClassVar[str] = (
        "a CAN232 speaks what {} names, LAWICEL's protocol: write type: can232"
    )

    def window_problem(self, transmit: TransmitConfig) -> str | None:
        """The frames of a window lie in the line, where they grow old uncounted: 27 characters each."""
        if transmit.window == 1 or not self.port.startswith("/"):
            return None
        frame_s = LONGEST_LINE * 10 / self.baudrate
        room = max(1, int(transmit.deadline_s / 2 / frame_s))
        if transmit.window <= room:
            return None
        taken = f"{transmit.window} frames take {transmit.window * frame_s:.2g} s at {self.baudrate} Bd"
        limit = f"more than half of the deadline of {transmit.deadline_s:g} s"
        return f"{taken}, {limit}, so they could be sent late; at most {room}"

    def window_warning(self, transmit: TransmitConfig) -> str | None:
        if transmit.window <= COMMANDS_MAX:
            return None
        return f"a CAN232 can hold {COMMANDS_MAX} commands, more of them may be lost"

    def notes(self, channel: ChannelConfig) -> list[str]:
        """What may be written to an EEPROM, what the firmware cannot do; unknown ones are refused."""
        lines = []
        profile = None if self.firmware is None else firmware.load(self.firmware)
        if profile is None or profile.polls:
            stored = may_be_stored(channel.acceptance)
            lines.append(f"may store in a CAN232's EEPROM, each only if it is not so already: {stored}")
        if profile is None:
            lines.append("unknown firmware is refused at start, unless adapter.firmware says what it is")
        elif problem := channel_problem(profile, channel):
            lines.append(f"will be refused at start: {problem}")
        return lines

    @property
    def where(self) -> str:
        return f"{self.port} at {self.baudrate} Bd"


SETTINGS = Can232Config


def make_adapter(settings: Can232Config, channel: ChannelConfig, memory: Memory) -> Can232:
    return Can232(settings, channel, memory)


def bitrate_command(profile: Profile, timing: BitTiming) -> bytes | None:
    r"""`S4\r` or `s031C\r` (manual, S and s); None: this firmware cannot be told this timing."""
    if timing.registers is None or (
        # There was no other way to write a bit rate that this firmware has a command for.
        not profile.registers and timing.bitrate not in STANDARD_REGISTERS
    ):
        command = profile.bitrates.get(timing.bitrate)
        return None if command is None else f"{command}\r".encode()
    return "s{:02X}{:02X}\r".format(*timing.registers).encode() if profile.registers else None


def channel_problem(profile: Profile, channel: ChannelConfig) -> str | None:
    """What this firmware cannot do of what the configuration wants."""
    acceptance = channel.acceptance
    if channel.listen_only and profile.listen_only is None:
        return f"{profile.article_title} has no listen-only mode: remove channel.listen_only"
    if bitrate_command(profile, channel.timing) is None:
        rates = ", ".join(str(rate) for rate in sorted(profile.bitrates))
        timing = channel.timing.description
        return f"{profile.article_title} cannot be set to {timing}; its bit rates are {rates}"
    if acceptance is not None and not acceptance.passes_all and not profile.acceptance:
        return f"{profile.article_title} has no such filter: remove channel.acceptance"
    return None


class Can232:
    """Sans-I/O: what to say to a device. `profile` and what follows from it is known after init_steps."""

    codec = "can232"
    flow: Flow | None = None
    discarded = 0  # it does not tell

    def __init__(self, adapter: Can232Config, channel: ChannelConfig, memory: Memory) -> None:
        self._settings = adapter
        self._channel = channel
        self.baudrate = adapter.baudrate
        # An answer may stand behind a full receive FIFO on the line: 10 bit times a character.
        self.answer_timeout_s = timeout_s = 0.2 + RECEIVE_FIFO * LONGEST_LINE * 10 / adapter.baudrate
        self._recognition = Recognition(adapter.port, adapter.baudrate, adapter.firmware, timeout_s)
        self._eeprom = Eeprom(memory, timeout_s)
        self.profile: Profile | None = None
        self.identity = Identity()
        self.sending = Sending()
        self.polling: Polling | None = None
        self.cautions: tuple[str, ...] = ()
        self.sync = self._ask_version(b"V")

    @property
    def sent_means(self) -> str | None:
        if self.profile is None:
            return None
        return SENT_MEANS[self.sending.confirms] + ("" if self.profile.in_order else ORDER_UNCERTAIN)

    @property
    def tells_full(self) -> bool:
        return self.profile is None or self.profile.full_flag

    @property
    def stops(self) -> bool:
        return self.profile is None or self.profile.stops

    def _step(
        self,
        request: bytes,
        purpose: str,
        accept: tuple[Reply, ...] = (OK,),
        reject: tuple[Reply, ...] = (REFUSED, NONE),
        *,
        prefix: bytes = b"",
        advice: str = "",
    ) -> Exchange:
        timeout_s = SILENT_STEP_S if accept == (NONE,) else self.answer_timeout_s
        return question(request, purpose, timeout_s, accept, reject, prefix=prefix, advice=advice)

    def _ask_version(self, prefix: bytes) -> Exchange:
        return self._step(b"V\r", "tell its version", (TEXT,), (NONE,), prefix=prefix)

    # --- start and end ------------------------------------------------------------------------

    def init_steps(self, serial_number: str | None, product: str | None = None) -> Steps:  # noqa: ARG002
        """Find out what is there, close, configure, open (manual 1.4); mend what a CAN232's EEPROM has wrong.

        Its serial number is another than that of the USB device, and told by N.
        """
        self.polling = None
        found = yield from self._recognition.steps(product)
        self.profile = profile = found.profile
        self.identity = self._eeprom.identity = found.identity._replace(firmware=profile.name)
        self.cautions = profile.cautions
        if self._channel.listen_only and profile.listen_only_warning:
            self.cautions += (profile.listen_only_warning,)
        self.sync = self._ask_version(found.version_prefix)
        self.sending = profile.sending
        if self.sending.keeps_buffer:
            self.sending = self.sending._replace(kept=profile.buffer)
        if profile.paced:
            self.sending = self.sending._replace(paced_bitrate=self._channel.timing.bitrate)
        self._refuse_unfit(profile)
        if not found.closed:
            yield from self._close(profile)
        yield from self._configure(profile)
        yield from self._open(profile)
        if profile.polls:
            yield from self._mend_eeprom(profile)

    def _refuse_unfit(self, profile: Profile) -> None:
        wanted, serial = self._settings.serial_number, self.identity.serial_number
        if wanted is not None and serial != wanted:
            found = serial or (
                "unknown" if profile.serial_number else f"none of its own, as {profile.article_title} has"
            )
            raise WrongDeviceError(
                f"the adapter on {self._settings.port} has serial number {found}, "
                f"adapter.serial_number wants {wanted}"
            )
        if problem := channel_problem(profile, self._channel):
            raise WrongDeviceError(f"the adapter on {self._settings.port} is not used: {problem}")

    def close_steps(self, drain: bool) -> Steps:
        """`C` until it is certain: the first may end a half command or meet an old answer.

        C throws away what is in the transmit FIFO, and those frames are answered: to drain it is to wait
        until they are on the bus, if others take up no more than half of it.
        """
        recognition, profile = self._recognition, self.profile
        if recognition.keep_off:
            return
        ask_version = self.sync._replace(accept=ANYTHING, reject=())
        if not recognition.flushed:  # nothing was sent to it yet but a part of the flush
            yield from recognition.flush()
            yield ask_version
            recognition.flushed = True
        elif drain and profile is not None:
            answer = yield ask_version  # answered after all frames
            if answer.reply is TEXT:
                on_bus_s = 2 * profile.buffer * LONGEST_FRAME_BITS / self._channel.timing.bitrate
                yield pause(min(on_bus_s, DRAIN_LONGEST_S))
        if profile is not None and NONE in profile.close_answers:
            yield from self._close(profile)
            return
        yield self._close_step()
        answer = yield self._close_step()
        if answer.reply is NONE:
            yield self._close_step()

    @property
    def last_words(self) -> bytes:
        """Nothing as long as a C might complete somebody's half command."""
        return b"C\rC\r" if self._recognition.flushed and not self._recognition.keep_off else b""

    def _close_step(self) -> Exchange:
        return self._step(b"C\r", "close the channel", (OK, REFUSED, NONE), ())

    def _close(self, profile: Profile) -> Steps:
        """Where C may have no answer, that V has one shows that the device has come as far as that."""
        if profile.close_answers == (NONE,):
            yield self._step(b"C\r", "close the channel", (NONE,), ())
        else:
            yield self._close_step()
        if NONE in profile.close_answers:
            yield self.sync._replace(accept=ANYTHING, reject=())

    # --- settings -----------------------------------------------------------------------------

    def _set(self, profile: Profile, request: bytes, purpose: str, advice: str = "") -> Exchange:
        """A command that is answered as all settings of this firmware are."""
        if profile.answers is None:
            return self._step(request, purpose, (OK, NONE), (REFUSED,), advice=advice)
        if not profile.answers:
            return self._step(request, purpose, (NONE,), ())
        return self._step(request, purpose, advice=advice)

    def _configure(self, profile: Profile) -> Steps:
        timing = self._channel.timing
        bitrate = bitrate_command(profile, timing)
        assert bitrate is not None  # see channel_problem()
        yield self._set(
            profile,
            bitrate,
            f"set the bit rate ({bitrate[:-1].decode()}, {timing.description})",
            advice="this firmware may not have it" + (": give btr0 and btr1" if profile.registers else ""),
        )
        if not profile.passes_all:
            return
        acceptance = self._channel.acceptance
        # Always, also to pass all: the device keeps what the program before us set until power-off.
        code, mask = (acceptance.code, acceptance.mask) if acceptance else (0, 0xFFFFFFFF)
        yield self._set(profile, f"M{code:08X}\r".encode(), f"set the acceptance code {code:#010x}")
        yield self._set(profile, f"m{mask:08X}\r".encode(), f"set the acceptance mask {mask:#010x}")

    # --- channel ------------------------------------------------------------------------------

    def _open(self, profile: Profile) -> Steps:
        commands = profile.listen_only if self._channel.listen_only else profile.open
        assert commands is not None  # see channel_problem()
        *before, last = commands
        for command in before:
            yield self._command(profile, command)
        answer = yield self._command(profile, last)._replace(opens=True)
        if answer.reply is NONE:
            self.sending = self.sending._replace(confirms=Confirms.NOTHING)  # nor will it answer a frame
            yield self.sync

    def _command(self, profile: Profile, command: Command) -> Exchange:
        step = self._set(profile, f"{command.text}\r".encode(), f"{command.purpose} ({command.text})")
        return step._replace(accept=(OK, REFUSED), reject=(NONE,)) if command.may_be_refused else step

    # --- a CAN232's EEPROM --------------------------------------------------------------------

    def _mend_eeprom(self, profile: Profile) -> Steps:
        auto_poll = yield from self._auto_poll()
        differences = self._eeprom.differences(self._channel.acceptance, auto_poll)
        if differences:
            yield from self._close(profile)
            for setting, value in differences:
                yield from self._eeprom.write(setting, value)
            yield from self._open(profile)
            auto_poll = auto_poll or (yield from self._auto_poll())
        if not auto_poll:
            log.info("firmware without auto poll: asking for frames with A every %g s", POLL_INTERVAL_S)
            self.polling = Polling(b"A\r", b"A", POLL_INTERVAL_S)

    def _auto_poll(self) -> Generator[Exchange, Answer, bool]:
        """Whether frames come by themselves: then A is refused (manual 2.0, A). X cannot be read."""
        answer = yield self._step(b"A\r", "tell whether it polls", (TEXT, REFUSED, NONE), (), prefix=b"A")
        return answer.reply is not TEXT

    # --- health -------------------------------------------------------------------------------

    def health_questions(self) -> tuple[Exchange, ...]:
        if self.profile is None or self.profile.flags:
            return (self._step(b"F\r", "tell its status flags", (TEXT, REFUSED, NONE), (), prefix=b"F"),)
        return (self.sync._replace(accept=(TEXT, REFUSED, NONE), reject=()),)

    def read_health(self, answers: Sequence[Answer | None]) -> Observation | None:
        (answer,) = answers
        if answer is None:
            return None
        if self.profile is None or self.profile.flags:
            if answer.reply is REFUSED:
                raise AdapterError("the adapter's channel is closed: it was reset, or lost its power")
            return _read_flags(answer.text, self.profile.bus_off_flag if self.profile else None)
        if answer.reply is REFUSED:
            return LOCKED
        return ANSWERS if answer.reply is TEXT else UNKNOWN

    def saw_time_stamps(self) -> None:
        if self.profile is None or self.profile.polls:
            self._eeprom.saw_time_stamps()

    def saw_noise(self, noise: bytes) -> None:  # noqa: ARG002
        self._recognition.saw_noise()

    def saw_text(self, text: bytes) -> None:
        self._recognition.saw_text(text)

    def read_report(self, text: bytes) -> Observation | None:  # noqa: ARG002 - it never speaks unasked
        return None


@functools.lru_cache(maxsize=16)
def _read_flags(answer: bytes, bus_off_flag: int | None) -> Observation:
    """`F` and two hex digits. Reading clears the flags: they say what happened since, not what is."""
    if not re.fullmatch(b"F[0-9A-Fa-f]{2}", answer):
        return UNKNOWN
    flags = int(answer[1:], 16)
    if bus_off_flag is not None and flags >> bus_off_flag & 1:
        return Observation("bus-off", BusState.BUS_OFF)
    happened = Happened.NOTHING
    for bit, what in HAPPENED.items():
        if flags >> bit & 1:
            happened |= what
    state = max((state for bit, state in STATES.items() if flags >> bit & 1), default=BusState.ERROR_ACTIVE)
    text = ", ".join(text for bit, text in STATUS_FLAGS.items() if flags >> bit & 1) or "no flags"
    return Observation(text, state, lasting=False, happened=happened)
