"""LAWICEL CAN232 and devices that speak its ASCII protocol (CAN232 manual, version 3)."""

from __future__ import annotations

import functools
import logging
import re
from typing import TYPE_CHECKING

from bridged.adapters.base import (
    Answer,
    Exchange,
    Flow,
    Identity,
    Memory,
    Polling,
    Reply,
    Steps,
    pause,
)
from bridged.errors import AdapterError, WrongDeviceError
from bridged.health import UNKNOWN, BusState, Happened, Observation

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from bridged.config import Can232Config, ChannelConfig

log = logging.getLogger(__name__)

OK, REFUSED, TEXT, NONE = Reply.OK, Reply.REFUSED, Reply.TEXT, Reply.NONE
ANYTHING = (OK, REFUSED, TEXT, NONE)

LONGEST_LINE = 27  # "T1FFFFFFF81122334455667788\r"
RECEIVE_FIFO = 32  # frames that may be on their way out before an answer (manual 1.3)
AUTO_POLL_SINCE = "1220"  # hhss of the first firmware with X (manual 2.0, P and A)
POLL_INTERVAL_S = 0.01
TRANSMIT_FIFO = 8  # frames (manual 1.3)
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


class Can232:
    """Sans-I/O: what to say to a CAN232. `identity` and `polling` hold what init_steps found out."""

    codec = "can232"
    flow: Flow | None = None
    discarded = 0  # it does not tell

    def __init__(self, adapter: Can232Config, channel: ChannelConfig, memory: Memory) -> None:
        self._port = adapter.port
        self.baudrate = adapter.baudrate
        self._wanted_serial = adapter.serial_number
        self._channel = channel
        self._memory = memory
        self._is_can232 = adapter.firmware == "can232"  # the user says so
        self._flushed = self._is_can232  # no half command of another program is in the device's buffer
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

    def init_steps(self, serial_number: str | None) -> Steps:  # noqa: ARG002 - it has one of its own (N)
        """Flush, close, identify, configure, open (manual 1.4), then mend what its EEPROM has wrong."""
        self.polling = None
        if self._is_can232:
            yield from self._flush_can232()
        else:
            self._flushed = False
            yield from self._flush()
        yield from self._identify()
        if not self._is_can232:
            yield from self._close()
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
        return b"C\rC\r" if self._flushed else b""

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
        for _ in range(IDENTIFY_TRIES):
            answer = yield self._step(b"V\r", "tell its version", (TEXT, REFUSED, NONE), (), prefix=b"V")
            self._flushed = True
            if answer.reply is TEXT:
                break
        else:
            if answer.reply is REFUSED:
                msg = f"the adapter on {self._port} refuses every command, V too: is it a CAN232, and well?"
                raise AdapterError(msg)
            msg = (
                f"no answer to V on {self._port} at {self.baudrate} Bd: is the adapter powered "
                f"(from the CAN side, 6-16 V), the baud rate right (its LEDs blink it at power-on), "
                f"the cable plugged?"
            )
            raise AdapterError(msg)
        version = answer.text.decode("ascii", "replace")
        if not re.fullmatch("V[0-9A-F]{4}", version):
            msg = f"the device on {self._port} answers V with {version!r}: not a CAN232 (Vhhss)"
            raise WrongDeviceError(msg)
        answer = yield self._step(b"N\r", "tell its serial number", (TEXT, REFUSED, NONE), (), prefix=b"N")
        serial = answer.text[1:].decode("ascii", "replace") if answer.reply is TEXT else None
        self.identity = Identity(version, serial)
        if self._wanted_serial is not None and serial != self._wanted_serial:
            msg = (
                f"the adapter on {self._port} has serial number {serial or 'unknown'}, "
                f"adapter.serial_number wants {self._wanted_serial}"
            )
            raise WrongDeviceError(msg)

    # --- settings -----------------------------------------------------------------------------

    def _configure(self) -> Steps:
        timing = self._channel.timing
        bitrate = timing.can232_command()
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
        purposes = {"X": "send frames by itself", "Z": "leave out time stamps", "W": "set the filter mode"}
        accept = (OK,) if setting == "W" else (OK, REFUSED)
        reject = tuple(reply for reply in (REFUSED, NONE) if reply not in accept)
        request = f"{setting}{value}"
        answer = yield self._step(f"{request}\r".encode(), f"{purposes[setting]} ({request})", accept, reject)
        if answer.reply is OK:
            log.info("wrote %s to the adapter's EEPROM: %s", request, purposes[setting])
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

    def saw_noise(self, noise: bytes) -> None:
        """A wrong baud rate is noticed by the answers that are missing."""

    def read_report(self, text: bytes) -> Observation | None:  # noqa: ARG002 - it never speaks unasked
        return None


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
