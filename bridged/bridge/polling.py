"""Asks the adapter of one bridge how its CAN bus is, logs the news and returns them."""

from __future__ import annotations

import functools
import logging
import time
from typing import TYPE_CHECKING

from bridged.adapters.base import UNKNOWN, Happened, Observation, Reply
from bridged.bridge.figures import Figures
from bridged.bridge.health import Finding, Health, Stall
from bridged.bridge.log_limiter import LogLimiter, repeated
from bridged.can import BusState
from bridged.errors import AdapterError

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged import _relay
    from bridged.adapters.base import Adapter, Answer, Exchange
    from bridged.bridge.exchanges import Found

log = logging.getLogger(__name__)

LOG_INTERVAL_S = 10.0
UNKNOWN_LIMIT = 4
NOISE = "noise on the line from the adapter"
NOISE_CAUSES = "a damaged cable, a wrong baud rate, or another program at its port"


class HealthLog:
    """Logs what the adapter says of its CAN bus, each thing not too often."""

    def __init__(self) -> None:
        self._states = LogLimiter()
        self._warnings = LogLimiter(LOG_INTERVAL_S)

    def state(self, state: BusState, description: str) -> None:
        """A CAN bus that is never well for long is not told each time."""
        if state is BusState.ERROR_ACTIVE:
            level = logging.DEBUG if self._states.quiet else logging.INFO
            log.log(level, "CAN bus: %s again", state.text)
            self._states.recovered()
            return
        times = self._states.should_log(state.text, time.monotonic())
        if times:
            log.warning("CAN bus: %s: %s%s", state.text, description, repeated(times))

    def warn(self, pattern: str, text: str) -> None:
        """Each text once in LOG_INTERVAL_S, and not too often in an hour."""
        times = self._warnings.should_log(pattern % text, time.monotonic())
        self._warnings.recovered()  # what comes again is news, if it does not come all the time
        if times:
            log.warning(f"{pattern}%s", text, repeated(times))


class Counted:
    """The relay's tally, and what is new in it."""

    def __init__(self, tally: Callable[[], _relay.Tally]) -> None:
        self.tally = tally
        self._overruns = 0
        self._noise = 0

    def begin(self, counted: _relay.Tally) -> None:
        """What was counted until now is not new."""
        self._overruns, self._noise = counted.rx_overruns, counted.skipped_bytes

    def has_noise(self, counted: _relay.Tally) -> bool:
        """Whether bytes without meaning came since this was asked last."""
        before, self._noise = self._noise, counted.skipped_bytes
        return counted.skipped_bytes != before

    def has_overruns(self, counted: _relay.Tally) -> bool:
        """Whether the adapter said since this was asked last that it lost received frames."""
        before, self._overruns = self._overruns, counted.rx_overruns
        return counted.rx_overruns != before


class Round:
    """Questions that were asked at once, and their answers as far as they have come."""

    def __init__(self, questions: int) -> None:
        self.answers: list[Answer | None] = [None] * questions
        self.asked_at = time.monotonic()
        self.is_overtaken = False  # the adapter spoke by itself meanwhile: some answers are older than that
        self._awaited = questions

    def take(self, number: int, answer: Answer) -> bool:
        """Whether the adapter is to read what has come: with the first answer, and with all."""
        self.answers[number] = answer
        self._awaited -= 1
        return number == 0 or self._awaited == 0


class HealthPolling:
    """All questions at once, and again `interval_s` after the last answer.

    `ask` sends an exchange, with the next one if there is more, and calls back with its answer; `tally` is
    the relay's. An adapter that transmits nothing for `stuck_s`, and was error-passive, may be bus-off.
    The owner calls on_timer() when `next_at` (seconds of time.monotonic()) has come.
    """

    def __init__(
        self,
        adapter: Adapter,
        interval_s: float,
        *,
        ask: Callable[[Exchange, Callable[[Answer], Found], bool], None],
        stuck_s: float,
        tally: Callable[[], _relay.Tally],
    ) -> None:
        self.health = Health()
        self.next_at: float | None = None
        self._adapter = adapter
        self._interval_s = interval_s
        self._ask = ask
        self._stall = Stall(stuck_s)
        self._counted = Counted(tally)
        self._figures = Figures()
        self._log = HealthLog()
        self._round: Round | None = None  # that is under way
        self._unknown = 0  # rounds one after the other without an answer
        self._refused = False  # frames, since the last round

    def start(self, now: float, *, restarted: bool = False) -> Finding:
        """The adapter runs; `restarted`: after bus-off."""
        finding = Finding()
        if restarted:
            finding = self._take(Observation("restarted", happened=Happened.RESTARTED))
        counted = self._counted.tally()
        self._counted.begin(counted)
        self._stall = Stall(self._stall.limit_s, counted.decoded, _taken(counted))
        self._unknown = 0
        self.next_at = now
        return finding

    def taken_off(self) -> Finding:
        """The adapter is bus-off, or taken for it, and its channel is being closed."""
        return Finding(tuple(self.health.taken_off()))

    def stop(self) -> None:
        """The adapter is no more: whatever it still answers is of no interest."""
        self.next_at = None
        self._round = None
        self._refused = False
        self._figures.forget_rates()
        self.health.forget()

    def reconfigure(self, interval_s: float, stuck_s: float) -> None:
        """Other settings."""
        self._interval_s = interval_s
        self._stall.limit_s = stuck_s

    def snapshot(self) -> dict[str, object]:
        """For the status: the state of the CAN bus, and how quickly frames go and the adapter answers."""
        health = self.health
        return {
            "bus_state": health.state.text if health.state is not None else None,
            "tec": health.tec,
            "rec": health.rec,
            "rates": self.rates(),
            "answer_time_ms": self._figures.answer_times_ms(),
        }

    def rates(self) -> dict[str, float]:
        """Frames a second each way."""
        return self._figures.rates()

    def on_timer(self, now: float) -> None:
        if self.next_at is not None and self.next_at <= now:
            self._look()

    def frame_refused(self) -> None:
        """Asks why, at once: a refusal itself does not say."""
        self._refused = True
        if self.next_at is not None:
            self._look()

    def heard(self, text: bytes) -> Finding:
        """Reads `text`, which the adapter said unasked."""
        log.debug("adapter said %r unasked", text)
        if self.next_at is None and self._round is None:
            self._adapter.saw_text(text)
            return Finding()
        try:
            seen = self._adapter.read_report(text)
        except AdapterError as error:
            return Finding(failure=str(error))
        if seen is None:
            return Finding()
        self._log.warn("adapter reports: %s", seen.description)
        if self._round is not None and seen.state is not None:
            self._round.is_overtaken = True
        return self._take(seen)

    def heard_noise(self) -> bool:
        """Whether bytes without meaning came since the last look, and since this was asked last."""
        return self._counted.has_noise(self._counted.tally())

    def was_full(self, seconds: float) -> bool:
        """Whether the adapter's transmit buffer was full in so many seconds before it was heard last.

        Not before now: a bridge that gets no processor time hears late. And two looks are allowed for: the
        adapter says so only if it has refused a frame since the look before.
        """
        return self.health.was_full(seconds + 2 * self._interval_s)

    def _look(self) -> None:
        self.next_at = None
        questions = self._adapter.health_questions()
        self._round = Round(len(questions))
        last = len(questions) - 1
        for number, question in enumerate(questions):
            self._ask(question, functools.partial(self._answered, self._round, number), number < last)

    def _answered(self, of: Round, number: int, answer: Answer) -> Found:
        if of is not self._round or not of.take(number, answer):
            return None
        now = time.monotonic()
        if number == 0 and answer.reply is not Reply.NONE:
            self._figures.answered(now - of.asked_at)
        try:
            seen = self._adapter.read_health(of.answers)
        except AdapterError as error:
            self._round = None
            return Finding(failure=str(error))
        if seen is None:
            return None
        self._round = None
        self.next_at = now + self._interval_s
        return self._looked(seen, now, is_overtaken=of.is_overtaken)

    def _looked(self, seen: Observation, now: float, *, is_overtaken: bool) -> Finding:
        if self._refused:
            self._refused = False
            self._log.warn("adapter refuses frames; its status: %s", seen.description)
        self._unknown = self._unknown + 1 if seen is UNKNOWN else 0
        if is_overtaken:
            seen = seen._replace(state=None, tec=None, rec=None)
        finding = self._take(seen)
        if self._unknown == UNKNOWN_LIMIT:
            return finding._replace(failure="the adapter does not answer questions about its bus")
        counted = self._counted.tally()
        self._figures.sample(now, counted.rx_frames, _taken(counted) + counted.tx_unconfirmed)
        if self._stall.observe(seen, now, counted.decoded, _taken(counted)):
            text = f"error-passive, and nothing received for {self._stall.limit_s:g} s"
            bus_off = f"{text}: the adapter may be bus-off, or no other node acknowledges its frames"
            return finding._replace(bus_off=finding.bus_off or bus_off)
        if not finding.bus_off and self._counted.has_noise(counted):
            self._log.warn(f"%s ({NOISE_CAUSES})", NOISE)
        if self._counted.has_overruns(counted):
            text = "the adapter lost received frames"
            self._log.warn("%s: they were not fetched quickly enough", text)
            overrun = self._take(Observation(text, happened=Happened.RX_OVERFLOW))
            finding = finding._replace(error_frames=finding.error_frames + overrun.error_frames)
        return finding

    def _take(self, seen: Observation) -> Finding:
        before = self.health.state
        frames = tuple(self.health.observe(seen, time.monotonic()))
        state = self.health.state
        if state is not None and state != before and (before is not None or state != BusState.ERROR_ACTIVE):
            self._log.state(state, seen.description)
            if state is BusState.BUS_OFF:
                return Finding(frames, bus_off=seen.description)
        return Finding(frames)


def _taken(counted: _relay.Tally) -> int:
    """Frames that the adapter took into its buffer, or put on its CAN bus, by its word."""
    return counted.tx_frames + counted.tx_queued
