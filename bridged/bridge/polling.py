"""Asks the adapter of one bridge how its CAN bus is, logs the news and returns them."""

from __future__ import annotations

import functools
import logging
import math
import time
from collections import deque
from typing import TYPE_CHECKING

from bridged.adapters.base import UNKNOWN, Happened, Observation, Reply
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
RATE_PERIOD_S = 1.0
ANSWER_TIMES = 256
UNKNOWN_LIMIT = 4
NOISE = "noise on the line from the adapter"
NOISE_CAUSES = "a damaged cable, a wrong baud rate, or another program at its port"


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
        self._tally = tally
        self._overruns_seen = 0
        self._noise_seen = 0
        self._asked_at = 0.0
        self._answer_times_s: deque[float] = deque(maxlen=ANSWER_TIMES)
        self._samples: deque[tuple[float, int, int]] = (
            deque()
        )  # time, frames to the bus, frames to the adapter
        self._answers: list[Answer | None] | None = None  # of the questions that are being asked
        self._awaited = 0  # those still to come
        self._unknown = 0  # looks one after the other without an answer
        self.description = ""  # what the adapter said last
        self._seen_at = 0.0
        self._full_at = -math.inf  # when it said last that its transmit buffer was full
        self._refused = False  # frames, since the last look
        self._overtaken = False  # the adapter spoke by itself meanwhile: some answers are older than that
        self._warning_limiter = LogLimiter(LOG_INTERVAL_S)
        self._log_limiter = LogLimiter()  # of bus states

    def start(self, now: float, *, restarted: bool = False) -> Finding:
        """The adapter runs; `restarted`: after bus-off."""
        finding = Finding()
        if restarted:
            finding = self._take(Observation("restarted", happened=Happened.RESTARTED))
        counted = self._tally()
        self._overruns_seen, self._noise_seen = counted.rx_overruns, counted.skipped_bytes
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
        self._answers = None
        self._refused = False
        self._samples.clear()
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
            "answer_time_ms": self.answer_times_ms(),
        }

    def answer_times_ms(self) -> dict[str, float] | None:
        """How long the adapter took for its last answers."""
        times = sorted(self._answer_times_s)
        if not times:
            return None
        picked = {"min": times[0], "median": times[len(times) // 2], "max": times[-1]}
        return {name: round(1000 * seconds, 3) for name, seconds in picked.items()}

    def rates(self) -> dict[str, float]:
        """Frames a second over the last RATE_PERIOD_S."""
        rates = {"rx_fps": 0.0, "tx_fps": 0.0}
        if len(self._samples) > 1:
            (begin, rx, tx), (end, rx_end, tx_end) = self._samples[0], self._samples[-1]
            rates = {"rx_fps": (rx_end - rx) / (end - begin), "tx_fps": (tx_end - tx) / (end - begin)}
        return {name: round(rate, 1) for name, rate in rates.items()}

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
        if self.next_at is None and self._answers is None:
            self._adapter.saw_text(text)
            return Finding()
        try:
            seen = self._adapter.read_report(text)
        except AdapterError as error:
            return Finding(failure=str(error))
        if seen is None:
            return Finding()
        self._warn("adapter reports: %s", seen.description)
        self._overtaken = self._overtaken or seen.state is not None
        return self._take(seen)

    def heard_noise(self) -> bool:
        """Whether bytes without meaning came since the last look, and since this was asked last."""
        return self._is_news(self._tally().skipped_bytes)

    def was_full(self, seconds: float) -> bool:
        """Whether the adapter's transmit buffer was full in so many seconds before it was heard last.

        Not before now: a bridge that gets no processor time hears late. And two looks are allowed for: the
        adapter says so only if it has refused a frame since the look before.
        """
        return self._seen_at - self._full_at <= seconds + 2 * self._interval_s

    def _is_news(self, noise: int) -> bool:
        before, self._noise_seen = self._noise_seen, noise
        return noise != before

    def _look(self) -> None:
        self.next_at = None
        self._overtaken = False
        questions = self._adapter.health_questions()
        answers: list[Answer | None] = [None] * len(questions)
        self._answers = answers
        self._awaited = len(questions)
        self._asked_at = time.monotonic()
        last = len(questions) - 1
        for number, question in enumerate(questions):
            self._ask(question, functools.partial(self._answered, answers, number), number < last)

    def _answered(self, answers: list[Answer | None], number: int, answer: Answer) -> Found:
        if answers is not self._answers:
            return None
        answers[number] = answer
        self._awaited -= 1
        if number and self._awaited:
            return None
        now = time.monotonic()
        if number == 0 and answer.reply is not Reply.NONE:
            self._answer_times_s.append(now - self._asked_at)
        try:
            seen = self._adapter.read_health(answers)
        except AdapterError as error:
            self._answers = None
            return Finding(failure=str(error))
        if seen is None:
            return None
        self._answers = None
        self.next_at = now + self._interval_s
        return self._looked(seen, now)

    def _looked(self, seen: Observation, now: float) -> Finding:
        if self._refused:
            self._refused = False
            self._warn("adapter refuses frames; its status: %s", seen.description)
        self._unknown = self._unknown + 1 if seen is UNKNOWN else 0
        if self._overtaken:
            seen = seen._replace(state=None, tec=None, rec=None)
        finding = self._take(seen)
        if self._unknown == UNKNOWN_LIMIT:
            return finding._replace(failure="the adapter does not answer questions about its bus")
        counted = self._tally()
        self._sample(now, counted.rx_frames, _taken(counted) + counted.tx_unconfirmed)
        if self._stall.observe(seen, now, counted.decoded, _taken(counted)):
            text = f"error-passive, and nothing received for {self._stall.limit_s:g} s"
            bus_off = f"{text}: the adapter may be bus-off, or no other node acknowledges its frames"
            return finding._replace(bus_off=finding.bus_off or bus_off)
        if not finding.bus_off and self._is_news(counted.skipped_bytes):
            self._warn(f"%s ({NOISE_CAUSES})", NOISE)
        if counted.rx_overruns != self._overruns_seen:
            self._overruns_seen = counted.rx_overruns
            text = "the adapter lost received frames"
            self._warn("%s: they were not fetched quickly enough", text)
            overrun = self._take(Observation(text, happened=Happened.RX_OVERFLOW))
            finding = finding._replace(error_frames=finding.error_frames + overrun.error_frames)
        return finding

    def _sample(self, now: float, rx_frames: int, tx_frames: int) -> None:
        self._samples.append((now, rx_frames, tx_frames))
        while len(self._samples) > 2 and now - self._samples[1][0] >= RATE_PERIOD_S:
            self._samples.popleft()

    def _take(self, seen: Observation) -> Finding:
        self.description = seen.description
        self._seen_at = time.monotonic()
        if seen.happened is not Happened.NOTHING and seen.happened & Happened.TX_FULL:
            self._full_at = self._seen_at
        before = self.health.state
        frames = tuple(self.health.observe(seen, self._seen_at))
        state = self.health.state
        if state is not None and state != before and (before is not None or state != BusState.ERROR_ACTIVE):
            self._log_state(state, seen.description)
            if state is BusState.BUS_OFF:
                return Finding(frames, bus_off=seen.description)
        return Finding(frames)

    def _log_state(self, state: BusState, description: str) -> None:
        """A bus that is never well for long is not told each time."""
        if state is BusState.ERROR_ACTIVE:
            level = logging.DEBUG if self._log_limiter.quiet else logging.INFO
            log.log(level, "CAN bus: %s again", state.text)
            self._log_limiter.recovered()
            return
        times = self._log_limiter.should_log(state.text, time.monotonic())
        if times:
            log.warning("CAN bus: %s: %s%s", state.text, description, repeated(times))

    def _warn(self, pattern: str, text: str) -> None:
        """Each text once in LOG_INTERVAL_S, and not too often in an hour."""
        times = self._warning_limiter.should_log(pattern % text, time.monotonic())
        self._warning_limiter.recovered()  # what comes again is news, if it does not come all the time
        if times:
            log.warning(f"{pattern}%s", text, repeated(times))


def _taken(counted: _relay.Tally) -> int:
    """Frames that the adapter took into its buffer, or put on its bus, by its word."""
    return counted.tx_frames + counted.tx_queued
