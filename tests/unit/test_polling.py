"""Questions about the bus, and what becomes of the answers."""

import time
from collections.abc import Sequence
from types import SimpleNamespace

import pytest

from bridged import _relay
from bridged.adapters.base import UNKNOWN, Answer, Exchange, Happened, Observation, Reply
from bridged.bridge import polling as polling_module
from bridged.bridge.health import Finding
from bridged.bridge.polling import UNKNOWN_LIMIT, HealthPolling
from bridged.can import BusState, error_frame, state_of
from bridged.errors import AdapterError


class Adapter:
    """Answers nothing by itself: the test does."""

    def __init__(self) -> None:
        self.seen = Observation("good", BusState.ERROR_ACTIVE, tec=0, rec=0)
        self.report: Observation | None = None
        self.broken = False
        self.texts: list[bytes] = []  # said while it does not run

    def saw_text(self, text: bytes) -> None:
        self.texts.append(text)

    def health_questions(self) -> tuple[Exchange, ...]:
        return (Exchange(b"?", "tell", (Reply.TEXT,)),) * 2

    def read_health(self, answers: Sequence[Answer | None]) -> Observation | None:
        if None in answers:
            return None
        if self.broken:
            raise AdapterError("channel closed")
        return self.seen

    def read_report(self, _text: bytes) -> Observation | None:
        return self.report


class Bench:
    def __init__(self) -> None:
        self.adapter = Adapter()
        self.asked: list[object] = []
        self.told: list[bytes] = []
        self.failed: list[str] = []
        self.off: list[str] = []
        names = (
            "decoded",
            "rx_frames",
            "tx_frames",
            "tx_queued",
            "tx_unconfirmed",
            "rx_overruns",
            "skipped_bytes",
        )
        self.counters = dict.fromkeys(names, 0)
        self.polling = HealthPolling(
            self.adapter,  # type: ignore[arg-type]
            0.25,
            ask=lambda _exchange, then, _more: self.asked.append(then),
            stuck_s=0.0,
            tally=lambda: _relay.Tally(self.counters.values()),
        )
        self.note(self.polling.start(0.0))
        self.polling.on_timer(0.0)

    def note(self, finding: Finding | None) -> None:
        """What the bridge is told."""
        if finding is not None:
            self.told += finding.error_frames
            self.failed += filter(None, [finding.failure])
            self.off += filter(None, [finding.bus_off])

    def hear(self) -> None:
        self.note(self.polling.heard(b"..."))

    def answer(self) -> None:
        self.note(self.asked.pop(0)(Answer(Reply.TEXT)))  # type: ignore[operator]

    def look(self) -> None:
        """A whole round."""
        self.polling.on_timer(1e9)
        for _ in range(2):
            self.answer()


def test_all_questions_at_once_and_the_next_round_only_after_the_last_answer() -> None:
    bench = Bench()
    bench.polling.on_timer(1e9)
    bench.polling.frame_refused()
    assert len(bench.asked) == 2
    bench.answer()
    bench.polling.on_timer(1e9)
    assert len(bench.asked) == 1
    bench.answer()
    assert bench.asked == []
    assert bench.polling.health.state is BusState.ERROR_ACTIVE
    bench.polling.on_timer(1e9)
    assert len(bench.asked) == 2


def test_answers_of_a_round_that_is_over_mean_nothing() -> None:
    bench = Bench()
    bench.answer()
    bench.polling.stop()
    bench.polling.start(0.0)
    bench.polling.on_timer(0.0)
    bench.answer()  # of the round before
    assert bench.polling.health.state is None
    bench.answer()
    bench.answer()
    assert bench.polling.health.state is BusState.ERROR_ACTIVE


def test_a_refusal_before_a_new_start_is_not_told_after_it(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()
    bench.polling.frame_refused()
    bench.polling.stop()
    bench.asked.clear()
    bench.polling.start(0.0)
    bench.look()
    assert caplog.messages == []
    bench.polling.frame_refused()
    bench.answer()
    bench.answer()
    assert caplog.messages == ["adapter refuses frames; its status: good"]


def test_answers_older_than_what_the_adapter_says_by_itself_are_not_believed() -> None:
    bench = Bench()
    bench.answer()
    bench.adapter.report = Observation("passive", BusState.ERROR_PASSIVE, tec=130, rec=0)
    bench.hear()
    bench.answer()
    assert bench.polling.health.state is BusState.ERROR_PASSIVE
    assert len(bench.told) == 1


def test_one_that_speaks_unasked_but_answers_nothing_is_initialised_again() -> None:
    bench = Bench()
    bench.adapter.seen = UNKNOWN
    bench.adapter.report = Observation("passive", BusState.ERROR_PASSIVE, tec=130, rec=0)
    for times in range(2):  # nor does it after that
        for _ in range(UNKNOWN_LIMIT):
            assert len(bench.failed) == times
            bench.polling.on_timer(1e9)
            bench.answer()
            bench.hear()
            bench.answer()
        assert bench.failed[times:] == ["the adapter does not answer questions about its bus"]
        assert bench.polling.health.state is BusState.ERROR_PASSIVE
        bench.polling.stop()
        bench.polling.start(0.0)


def test_a_frame_refused_between_two_rounds_is_explained_at_once() -> None:
    bench = Bench()
    bench.answer()
    bench.answer()
    bench.polling.frame_refused()
    assert len(bench.asked) == 2


def test_what_says_that_it_must_be_initialised_again() -> None:
    bench = Bench()
    bench.adapter.broken = True
    bench.answer()
    bench.answer()
    assert bench.failed == ["channel closed"]
    assert bench.polling.next_at is None


def test_bus_off_is_told_once() -> None:
    bench = Bench()
    bench.adapter.seen = Observation("bus-off", BusState.BUS_OFF, tec=127, rec=0)
    for _ in range(3):
        bench.look()
    assert bench.off == ["bus-off"]


def test_one_that_cannot_tell_bus_off_is_taken_for_it_when_nothing_seems_to_leave_it() -> None:
    bench = Bench()
    bench.look()
    bench.adapter.seen = Observation("", BusState.ERROR_PASSIVE, lasting=False)
    for _ in range(5):
        bench.look()
    assert bench.off == []  # it has no frame of ours
    bench.counters["tx_frames"] = 1
    bench.look()
    assert len(bench.off) == 1
    assert bench.off[0].startswith("error-passive, and nothing received for 0 s")


def test_restart_is_told_to_the_bus() -> None:
    bench = Bench()
    bench.polling.stop()
    bench.note(bench.polling.start(0.0, restarted=True))
    assert bench.told == [error_frame(0x100)]
    assert bench.polling.health.restarts == 1


def test_an_answer_after_the_end_means_nothing() -> None:
    bench = Bench()
    bench.polling.stop()
    bench.answer()
    bench.answer()
    assert (bench.asked, bench.polling.next_at, bench.polling.health.state) == ([], None, None)
    bench.hear()
    assert (bench.told, bench.adapter.texts) == ([], [b"..."])


def test_a_flood_of_reports_with_ever_new_counters_costs_little(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()
    began_s = time.process_time()
    for n in range(14_000):
        tec, rec = 128 + n % 128, n // 128
        seen = Observation(f"error-passive, TEC {tec}, REC {rec}", state_of(tec, rec), tec=tec, rec=rec)
        bench.adapter.report = seen
        bench.hear()
    assert time.process_time() - began_s < 0.3  # 0.05 s on a usual machine; quadratic it was 10 s
    assert len(caplog.records) < 10


def test_overruns_are_told_to_the_bus() -> None:
    bench = Bench()
    bench.counters["rx_overruns"] = 3
    bench.answer()
    bench.answer()
    (frame,) = bench.told
    assert frame[9] == 0x01  # CRTL_RX_OVERFLOW


def test_a_full_buffer_is_what_the_adapter_said_last_however_late_the_bridge_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 1000.0
    monkeypatch.setattr(polling_module, "time", SimpleNamespace(monotonic=lambda: now))
    bench = Bench()
    assert not bench.polling.was_full(0.5)
    for flags, later, full in [
        (Happened.TX_FULL, 0.0, True),
        (Happened.NOTHING, 0.9, True),
        (Happened.NOTHING, 0.2, False),
    ]:
        now += later
        bench.adapter.seen = Observation("flags", happened=flags)
        while bench.asked:
            bench.answer()
        bench.polling.on_timer(1e9)
        now += 5.0
        assert bench.polling.was_full(0.5) == full
        now -= 5.0
