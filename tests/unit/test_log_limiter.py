"""How often a cause may be in the log."""

from __future__ import annotations

import string

from bridged.bridge.log_limiter import CAUSES_MAX, LOGGED_AT_MOST, REPEAT_LOG_S, LogLimiter


def test_a_cause_is_told_once_until_all_is_well_again() -> None:
    limiter = LogLimiter()
    assert (limiter.failing, limiter.quiet) == (False, False)
    assert [limiter.should_log("a", n) for n in range(3)] == [1, 0, 0]
    assert limiter.should_log("b", 3) == 1
    assert (limiter.failing, limiter.quiet) == (True, False)
    limiter.recovered()
    assert (limiter.failing, limiter.quiet) == (False, True)
    assert limiter.should_log("a", 4) == 3
    assert limiter.should_log("a", 5) == 0
    assert not limiter.quiet


def test_what_comes_and_goes_is_not_told_each_time() -> None:
    limiter = LogLimiter()
    times = []
    for n in range(20):
        times.append(limiter.should_log("flaps", n))
        limiter.recovered()
    assert times == [1] * LOGGED_AT_MOST + [0] * (20 - LOGGED_AT_MOST)
    assert limiter.should_log("flaps", 20) == 0
    assert limiter.quiet  # so that its end is not told either


def test_what_lasts_is_told_again_and_how_often_it_came() -> None:
    limiter = LogLimiter()
    times = [limiter.should_log("silent", now) for now in range(0, 2 * int(REPEAT_LOG_S) + 1, 5)]
    per_time = int(REPEAT_LOG_S) // 5
    assert [n for n in times if n] == [1, per_time, per_time]


def test_causes_are_not_told_apart_by_numbers_and_their_number_is_bounded() -> None:
    limiter = LogLimiter()
    assert [limiter.should_log(f"TEC {n}", 0) for n in range(3)] == [1, 0, 0]
    texts = [f"{a}{b}" for a in string.ascii_letters for b in string.ascii_letters]
    assert sum(limiter.should_log(text, 1) > 0 for text in texts) == CAUSES_MAX
    assert len(limiter._causes) == CAUSES_MAX + 1
    assert limiter.should_log("all others are forgotten by then", 3 * REPEAT_LOG_S) == 1
    assert len(limiter._causes) == 1


def test_an_interval_between_two_lines_of_a_cause() -> None:
    limiter = LogLimiter(interval_s=10.0)
    times = []
    for now in (0, 5, 9, 10, 19, 20):
        times.append(limiter.should_log("noise", now))
        limiter.recovered()
    assert times == [1, 0, 0, 3, 0, 2]
