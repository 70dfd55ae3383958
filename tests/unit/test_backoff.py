"""Pauses before the next try."""

from __future__ import annotations

import pytest

from bridged.bridge.backoff import JITTER, STABLE_S, Backoff


def test_pauses_double_to_their_maximum() -> None:
    backoff = Backoff(0.1, 1.0, lambda: 0.0)
    assert [backoff.next_s(0.0) for _ in range(5)] == [0.1, 0.2, 0.4, 0.8, 1.0]
    backoff.reset()
    assert backoff.next_s(0.0) == 0.1
    assert backoff.longest_s() == 1.0
    assert backoff.next_s(0.0) == 0.2


def test_pauses_differ_but_never_exceed_the_maximum() -> None:
    random = iter([0.0, 0.5, 1.0])
    backoff = Backoff(5.0, 5.0, lambda: next(random))
    pauses = [backoff.next_s(0.0), backoff.next_s(0.0), backoff.longest_s()]
    assert pauses == pytest.approx([5.0, 5.0 * (1 - JITTER / 2), 5.0 * (1 - JITTER)])


@pytest.mark.parametrize(("ran_s", "pause_s"), [(STABLE_S - 0.1, 0.8), (STABLE_S, 0.1)])
def test_only_a_stable_run_makes_pauses_short_again(ran_s: float, pause_s: float) -> None:
    backoff = Backoff(0.1, 5.0, lambda: 0.0)
    for _ in range(3):
        backoff.next_s(1000.0)
    backoff.runs(1000.0)
    assert backoff.coming_s(1000.0 + ran_s) == pause_s
    assert backoff.next_s(1000.0 + ran_s) == pause_s
    assert backoff.next_s(5000.0) == 2 * pause_s  # it did not run since
