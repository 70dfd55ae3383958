"""LAWICEL CAN232 and devices that speak its ASCII protocol (CAN232 manual, version 3)."""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Mapping  # noqa: TC003 - msgspec looks at the annotations
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal

from msgspec import Meta

from bridged.adapters.base import (
    UNKNOWN,
    Answer,
    Baudrate,
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
from bridged.can import BusState
from bridged.errors import AdapterError, WrongDeviceError
from bridged.settings import AdapterConfig, After
from bridged.text import printable

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from bridged.can import BitTiming
    from bridged.settings import ChannelConfig, TransmitConfig

log = logging.getLogger(__name__)

OK, REFUSED, TEXT, NONE = Reply.OK, Reply.REFUSED, Reply.TEXT, Reply.NONE
ANYTHING = (OK, REFUSED, TEXT, NONE)

LONGEST_LINE = 27  # "T1FFFFFFF81122334455667788\r"
RECEIVE_FIFO = 32  # frames that may be on their way out before an answer (manual 1.3)
AUTO_POLL_SINCE = "1220"  # hhss of the first firmware with X (manual 2.0, P and A)
POLL_INTERVAL_S = 0.01
TRANSMIT_FIFO = 8  # frames (manual 1.3)
COMMANDS_MAX = 2  # that the buffer of its serial line holds (manual)
LONGEST_FRAME_BITS = 160  # extended, 8 bytes, as many stuff bits as there can be, the pause behind it

# A command that a crashed program left half typed may be in the device's buffer. A CR would finish it: a
# frame from another time goes out on a live bus. A "C" might even complete it, being a hex digit. "V"
# is no hex digit, makes a half command invalid, and alone only asks for the version.
#
# A CAN232 looks at the whole line, so as many as a line holds are enough, with their CR.
SHORT_FLUSH = b"V" * (LONGEST_LINE - 1) + b"\r"

# Other firmware may send what such a line begins with, whatever follows. But its buffer overflows, after
# 30 to 165 characters, and then begins anew (or the line is thrown away). So more than any buffer holds, and
# no CR before it has overflowed. In pieces that fit into a USB packet (64 bytes) each. What forgets a half
# command after a silence (10 ms, 50 ms) has forgotten all of it after the pause.
FLUSH_PIECE = b"V" * 50
FLUSH_PIECES = 4
FLUSH_PAUSE_S = 0.06
IDENTIFY_TRIES = 4  # the first V ends the line of the flush, which a CAN232 refuses

# Other firmware than a CAN232's, by what it answers: V.
NAMES_BY_VERSION = {
    rb"VL2K.*": "a CANable with the firmware of Nakakiyo092",
    rb"VW1K.*": "a USB2CANFDV1 with the firmware of Nakakiyo092",
    rb"WeAct.*": "a WeAct USB2CANFDV1",
    rb"\+Board.*": "a CANable with the firmware of Elmue",
    rb".*(?i:canable|cantact).*": "a CANable with slcan firmware",
}
# V and N, which are the same in every device of that kind.
NAMES_BY_NUMBERS = {
    ("V0100", "FFFF"): "a USBtin",
    ("V1013", "4242"): "slcanpty",
    ("V1013", "A123"): "an Arduino with slcan firmware",
    ("V1234", "1234"): "an Arduino with slcanuino",
    ("V1234", "2233"): "an ESP32 with esp32-slcan",
}
# v, which a CAN232 refuses.
NAMES_BY_DETAILS = {rb"v01\d\d": "a USBtin", rb"v0401": "a UCCB", rb"v: .*": "the firmware of Nakakiyo092"}
# The buffer of this one overflows with more than 30 characters: the others after it are overwritten.
CANTACT = "CANtact"  # "CANtact dev", "CANtact b12": USB product ad50:60c4
LONGEST_SHOWN = 120
HEARD_KEPT = 16

# What is kept in the EEPROM: what to ask of the adapter, and what it is good for; each value's name.
EEPROM_PURPOSES = {
    "X": ("send frames by itself", "it now sends received frames unasked"),
    "Z": ("leave out time stamps", "received frames now take less of its line"),
    "W": ("set the filter mode", "it now reads code and mask as channel.acceptance means them"),
}
EEPROM_NAMES = {
    "X1": "auto poll",
    "Z0": "no time stamps",
    "W0": "filter mode dual",
    "W1": "filter mode single",
}

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

BITRATE_COMMANDS: Final = {
    10_000: "S0",
    20_000: "S1",
    50_000: "S2",
    100_000: "S3",
    125_000: "S4",
    250_000: "S5",
    500_000: "S6",
    800_000: "S7",
    1_000_000: "S8",
}
"""bit/s → command (manual, `Sn`). Some clones set 750 kbit/s for S7."""

Firmware = Annotated[Literal["can232"], Meta(description="can232")]


class Can232Config(AdapterConfig, frozen=True, kw_only=True):
    """A CAN232, and how to reach it. `port` is an absolute path or a pyserial URL; `baudrate` in bit/s.

    `firmware` "can232": what is there is a CAN232 for certain; None: it may be a clone, and is treated so
    until it has said what it is.
    """

    type: TypeName
    port: PortText
    baudrate: Baudrate = 57_600
    serial_number: SerialNumber | None = None  # of the CAN232 itself, which the USB device has not
    firmware: Firmware | None = None

    default_window: ClassVar[int] = 1
    default_restart = After(0.1)
    bitrates = BITRATE_COMMANDS.keys()
    schemes: ClassVar[tuple[str, ...]] = ("socket", "rfc2217")
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
        """What may be written to the EEPROM, and what becomes of a clone."""
        stored = ["X1", "Z0"]
        acceptance = channel.acceptance
        if acceptance is not None and not acceptance.passes_all:
            stored.append(f"W{acceptance.single:d}")
        names = ", ".join(f"{request} ({EEPROM_NAMES[request]})" for request in stored)
        lines = [f"may store in the adapter's EEPROM, each only if it is not so already: {names}"]
        if self.firmware is None:
            lines.append("a clone that is recognised is refused at start, unless adapter.firmware is can232")
        return lines

    @property
    def where(self) -> str:
        return f"{self.port} at {self.baudrate} Bd"


SETTINGS = Can232Config


def make_adapter(settings: Can232Config, channel: ChannelConfig, memory: Memory) -> Can232:
    return Can232(settings, channel, memory)


def bitrate_command(timing: BitTiming) -> bytes:
    r"""`S4\r` or `s031C\r` (manual, S and s)."""
    if timing.registers is None:
        return f"{BITRATE_COMMANDS[timing.bitrate]}\r".encode()
    return "s{:02X}{:02X}\r".format(*timing.registers).encode()


class Can232:
    """Sans-I/O: what to say to a CAN232. `identity` and `polling` hold what init_steps found out."""

    codec = "can232"
    flow: Flow | None = None
    discarded = 0  # it does not tell
    sending = Sending()

    def __init__(self, adapter: Can232Config, channel: ChannelConfig, memory: Memory) -> None:
        self._port = adapter.port
        self.baudrate = adapter.baudrate
        self._wanted_serial = adapter.serial_number
        self._channel = channel
        self._memory = memory
        self._is_can232 = adapter.firmware == "can232"  # the user says so
        self._flushed = self._is_can232  # no half command of another program is in the device's buffer
        self._keep_off = False  # not a byte may be sent to what is there
        self._heard: list[bytes] = []  # texts that answer no request, since V was asked first
        self._noise = False  # was heard since then
        self._stamped = False
        self.identity = Identity()
        self.polling: Polling | None = None
        # An answer may stand behind a full receive FIFO on the line: 10 bit times a character.
        self.answer_timeout_s = 0.2 + RECEIVE_FIFO * LONGEST_LINE * 10 / adapter.baudrate
        self._flags_step = self._step(b"F\r", "tell its status flags", (TEXT, REFUSED, NONE), (), prefix=b"F")
        self.sync = self._step(b"V\r", "tell its version", (TEXT,), (NONE,), prefix=b"V")

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
        return Exchange(request, purpose, accept, reject, prefix, advice, self.answer_timeout_s)

    # --- start and end ------------------------------------------------------------------------

    def init_steps(self, serial_number: str | None, product: str | None = None) -> Steps:  # noqa: ARG002
        """Flush, identify, close, configure, open (manual 1.4), then mend what its EEPROM has wrong.

        Its serial number is another than that of the USB device, and told by N.
        """
        self.polling = None
        self._keep_off = product is not None and product.startswith(CANTACT)
        if self._keep_off:
            msg = (
                f"the USB device of {self._port} calls itself '{product}': no CAN232, and the "
                f"first bytes of any flush would overwrite its memory, so nothing is sent to it"
            )
            raise WrongDeviceError(msg)
        if self._is_can232:
            yield from self._flush_can232()
            yield from self._identify()
        else:
            self._flushed = False
            yield from self._flush()
            yield from self._identify()
            yield from self._recognise()
        yield from self._configure()
        yield from self._open()
        auto_poll = yield from self._auto_poll()
        differences = self._eeprom_differences(auto_poll)
        if differences:
            yield from self._close()
            for setting, value in differences:
                yield from self._write_eeprom(setting, value)
            yield from self._open()
            auto_poll = auto_poll or (yield from self._auto_poll())
        if not auto_poll:
            log.info("firmware without auto poll: asking for frames with A every %g s", POLL_INTERVAL_S)
            self.polling = Polling(b"A\r", b"A", POLL_INTERVAL_S)

    def close_steps(self, drain: bool) -> Steps:
        """`C` until it is certain: the first may end a half command or meet an old answer.

        C throws away what is in the transmit FIFO, and those frames are answered: to drain it is to wait
        until they are on the bus, if others take up no more than half of it.
        """
        if self._keep_off:
            return
        if not self._flushed:  # nothing was sent to it yet but a part of the flush
            yield from self._flush()
            yield self.sync._replace(accept=ANYTHING, reject=())
            self._flushed = True
        elif drain:
            answer = yield self.sync._replace(accept=ANYTHING, reject=())  # answered after all frames
            if answer.reply is TEXT:
                yield pause(2 * TRANSMIT_FIFO * LONGEST_FRAME_BITS / self._channel.timing.bitrate)
        yield from self._close()
        answer = yield self._step(b"C\r", "close the channel", (OK, REFUSED, NONE), ())
        if answer.reply is NONE:
            yield from self._close()

    @property
    def last_words(self) -> bytes:
        """Nothing as long as a C might complete somebody's half command."""
        return b"C\rC\r" if self._flushed and not self._keep_off else b""

    def _flush(self) -> Steps:
        """For a device of which nothing is known yet. The line is still to be ended, by `V`: a lone CR means
        different things to different firmware (the last frame once more, the first byte of a command)."""
        for _ in range(FLUSH_PIECES):
            on_the_line_s = len(FLUSH_PIECE) * 10 / self.baudrate
            yield Exchange(
                FLUSH_PIECE, "drop a half-typed command", (NONE,), (), timeout_s=on_the_line_s
            )  # whatever answers it is of no interest
        yield pause(FLUSH_PAUSE_S)

    def _flush_can232(self) -> Steps:
        """Lone CRs, as the manual wants them, only once the channel is closed: on an open one some
        clones answer them by sending their last frame again."""
        yield self._step(SHORT_FLUSH, "drop a half-typed command", ANYTHING, (), prefix=b"V")
        yield from self._close()
        yield self._step(b"\r\r", "empty its command buffer", ANYTHING, ())

    def _close(self) -> Steps:
        yield self._step(b"C\r", "close the channel", (OK, REFUSED, NONE), ())

    def _identify(self) -> Steps:
        self._heard, self._noise = [], False
        replies = []
        ask = self._step(b"V\r", "tell its version", (TEXT, REFUSED, NONE), (), prefix=b"V")
        for number in range(IDENTIFY_TRIES):
            # An empty line may be the late answer to something else, but not each time.
            answer = yield ask._replace(accept=ANYTHING) if number == IDENTIFY_TRIES - 1 else ask
            self._flushed = True
            replies.append(answer.reply)
            if answer.reply is TEXT:
                break
        else:
            raise self._unidentified(replies)
        version = answer.text.decode("ascii", "replace")
        if not re.fullmatch("V[0-9A-F]{4}", version):
            raise self._not_a_can232(answer.text)
        answer = yield self._step(b"N\r", "tell its serial number", (TEXT, REFUSED, NONE), (), prefix=b"N")
        serial = answer.text[1:].decode("ascii", "replace") if answer.reply is TEXT else None
        self.identity = Identity(version, serial)
        if self._wanted_serial is not None and serial != self._wanted_serial:
            msg = (
                f"the adapter on {self._port} has serial number {serial or 'unknown'}, "
                f"adapter.serial_number wants {self._wanted_serial}"
            )
            raise WrongDeviceError(msg)

    def _unidentified(self, replies: Sequence[Reply]) -> AdapterError:
        """Why no answer to V begins with V. Noise may look like a text, but not always like the same one."""
        text = max(self._heard, key=self._heard.count, default=b"")
        if text and (not self._noise or self._heard.count(text) >= IDENTIFY_TRIES - 1):
            return self._not_a_can232(text)
        if REFUSED in replies:
            return AdapterError(
                f"the adapter on {self._port} refuses every command, V too: is it a CAN232, and well?"
            )
        if OK in replies:
            return WrongDeviceError(f"the device on {self._port} answers V with an empty line: not a CAN232")
        if self._noise:
            return AdapterError(
                f"only noise answers V on {self._port} at {self.baudrate} Bd: is the baud rate right "
                f"(its LEDs blink it at power-on)?"
            )
        return AdapterError(
            f"no answer to V on {self._port} at {self.baudrate} Bd: is the adapter powered "
            f"(from the CAN side, 6-16 V), the baud rate right (its LEDs blink it at power-on), "
            f"the cable plugged?"
        )

    def _not_a_can232(self, version: bytes) -> WrongDeviceError:
        name = _name_of(version, NAMES_BY_VERSION)
        what = f"probably {name}, not a CAN232" if name else "not a CAN232 (Vhhss)"
        return WrongDeviceError(f"the device on {self._port} answers V with {_shown(version)}: {what}")

    def _recognise(self) -> Steps:
        """Refuses what answers V like a CAN232 and then gives itself away. The channel is closed then.

        Asks only what no known firmware takes for an order: v, and F on a closed channel. (N is asked before,
        without digits. X, W, U, Q, A, M1 write flash, registers or pins somewhere, or start a bootloader.)
        """
        version, serial = self.identity.version or "", self.identity.serial_number or ""
        if name := NAMES_BY_NUMBERS.get((version, serial)):
            raise self._clone(f"V with '{version}' and N with 'N{serial}'", name)
        answer = yield self._step(
            b"v\r", "tell its version in detail", (TEXT, REFUSED, NONE), (), prefix=b"v"
        )
        if answer.reply is TEXT:
            name = _name_of(answer.text, NAMES_BY_DETAILS)
            raise self._clone(f"v with {_shown(answer.text)}", name)
        for _ in range(2):  # a CAN232 answers F, too, if C did not reach it
            yield from self._close()
            self._heard = []
            answer = yield self._flags_step
            flags = answer.text if answer.reply is TEXT else b"".join(self._heard[-1:])
            if not flags:
                return
        raise self._clone(f"F with {_shown(flags)} while its channel is closed", None)

    def _clone(self, seen: str, name: str | None) -> WrongDeviceError:
        return WrongDeviceError(
            f"the device on {self._port} answers {seen}: {f'probably {name}, ' if name else ''}not a CAN232, "
            f"so it is not used; `firmware: can232` in section adapter takes it for one all the same"
        )

    # --- settings -----------------------------------------------------------------------------

    def _configure(self) -> Steps:
        timing = self._channel.timing
        bitrate = bitrate_command(timing)
        yield self._step(
            bitrate,
            f"set the bit rate ({bitrate[:-1].decode()}, {timing.description})",
            advice="this firmware may not have it: give btr0 and btr1",
        )
        acceptance = self._channel.acceptance
        # Always, also to pass all: the device keeps what the program before us set until power-off.
        code, mask = (acceptance.code, acceptance.mask) if acceptance else (0, 0xFFFFFFFF)
        yield self._step(f"M{code:08X}\r".encode(), f"set the acceptance code {code:#010x}")
        yield self._step(f"m{mask:08X}\r".encode(), f"set the acceptance mask {mask:#010x}")

    # --- EEPROM: cells wear out and cannot be read; written only what is not known to be there --------

    def _recall(self, setting: str) -> int | None:
        serial = self.identity.serial_number
        return None if serial is None else self._memory.recall(serial, setting)

    def _remember(self, setting: str, value: int) -> None:
        if self.identity.serial_number is not None:
            self._memory.remember(self.identity.serial_number, setting, value)

    def _eeprom_differences(self, auto_poll: bool) -> list[tuple[str, int]]:
        """What must be written. X is known from A, Z from frames that came, W only from what we wrote.

        With X as it left the factory W is taken to be so too: whoever sets one sets the other.
        """
        differences = []
        if not auto_poll and (self.identity.version or "")[1:] >= AUTO_POLL_SINCE:
            differences.append(("X", 1))
        if self._stamped or self._recall("Z") == 1:
            differences.append(("Z", 0))
        known = self._recall("W")
        if known is None and not auto_poll:
            known = 0
            self._remember("W", known)
        acceptance = self._channel.acceptance
        if acceptance is not None and not acceptance.passes_all and known != acceptance.single:
            differences.append(("W", int(acceptance.single)))
        return differences

    def _write_eeprom(self, setting: str, value: int) -> Steps:
        """A firmware that refuses X is polled, one that refuses Z says nothing wrong; a filter must hold."""
        purpose, effect = EEPROM_PURPOSES[setting]
        accept = (OK,) if setting == "W" else (OK, REFUSED)
        reject = tuple(reply for reply in (REFUSED, NONE) if reply not in accept)
        request = f"{setting}{value}"
        answer = yield self._step(f"{request}\r".encode(), f"{purpose} ({request})", accept, reject)
        if answer.reply is OK:
            log.info("stored '%s' (%s) in the adapter's EEPROM: %s", EEPROM_NAMES[request], request, effect)
            self._remember(setting, value)
        self._stamped = self._stamped and setting != "Z"

    # --- channel ------------------------------------------------------------------------------

    def _open(self) -> Steps:
        if self._channel.listen_only:
            step = self._step(b"L\r", "open the channel in listen-only mode (L)")
        else:
            step = self._step(b"O\r", "open the channel (O)")
        yield step._replace(opens=True)

    def _auto_poll(self) -> Generator[Exchange, Answer, bool]:
        """Whether frames come by themselves: then A is refused (manual 2.0, A). X cannot be read."""
        answer = yield self._step(b"A\r", "tell whether it polls", (TEXT, REFUSED, NONE), (), prefix=b"A")
        return answer.reply is not TEXT

    # --- health -------------------------------------------------------------------------------

    def health_questions(self) -> tuple[Exchange, ...]:
        return (self._flags_step,)

    def read_health(self, answers: Sequence[Answer | None]) -> Observation | None:
        (answer,) = answers
        if answer is not None and answer.reply is REFUSED:
            raise AdapterError("the adapter's channel is closed: it was reset, or lost its power")
        return None if answer is None else _read_flags(answer.text)

    def saw_time_stamps(self) -> None:
        if self._stamped:
            return
        self._stamped = True
        self._remember("Z", 1)
        log.warning("adapter sends time stamps (Z1), a sixth of its line; switched off at the next start")

    def saw_noise(self, noise: bytes) -> None:  # noqa: ARG002
        self._noise = True

    def saw_text(self, text: bytes) -> None:
        self._heard = [*self._heard[1 - HEARD_KEPT :], text]

    def read_report(self, text: bytes) -> Observation | None:  # noqa: ARG002 - it never speaks unasked
        return None


def _name_of(answer: bytes, names: Mapping[bytes, str]) -> str | None:
    return next((name for pattern, name in names.items() if re.fullmatch(pattern, answer)), None)


def _shown(answer: bytes) -> str:
    text = printable(answer.decode("ascii", "replace"))
    return f"'{text}'" if len(text) <= LONGEST_SHOWN else f"'{text[:LONGEST_SHOWN]}…'"


@functools.lru_cache(maxsize=16)
def _read_flags(answer: bytes) -> Observation:
    """`F` and two hex digits. Reading clears the flags: they say what happened since, not what is."""
    if not re.fullmatch(b"F[0-9A-Fa-f]{2}", answer):
        return UNKNOWN
    flags = int(answer[1:], 16)
    happened = Happened.NOTHING
    for bit, what in HAPPENED.items():
        if flags >> bit & 1:
            happened |= what
    state = max((state for bit, state in STATES.items() if flags >> bit & 1), default=BusState.ERROR_ACTIVE)
    text = ", ".join(text for bit, text in STATUS_FLAGS.items() if flags >> bit & 1) or "no flags"
    return Observation(text, state, lasting=False, happened=happened)
