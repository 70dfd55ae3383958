"""How often a cause may be in the log."""

from __future__ import annotations

import string

from bridged.bridge.log_limiter import CAUSES_MAX, REPEAT_LOG_S, TOLD_AT_MOST, LogLimiter


def test_a_cause_is_told_once_until_all_is_well_again() -> None:
    told = LogLimiter()
    assert (told.failing, told.quiet) == (False, False)
    assert [told.tell("a", n) for n in range(3)] == [1, None, None]
    assert told.tell("b", 3) == 1
    assert (told.failing, told.quiet) == (True, False)
    told.well()
    assert (told.failing, told.quiet) == (False, True)
    assert told.tell("a", 4) == 3
    assert told.tell("a", 5) is None
    assert not told.quiet


def test_what_comes_and_goes_is_not_told_each_time() -> None:
    told = LogLimiter()
    times = []
    for n in range(20):
        times.append(told.tell("flaps", n))
        told.well()
    assert times == [1] * TOLD_AT_MOST + [None] * (20 - TOLD_AT_MOST)
    assert told.tell("flaps", 20) is None
    assert told.quiet  # so that its end is not told either


def test_what_lasts_is_told_again_and_how_often_it_came() -> None:
    told = LogLimiter()
    times = [told.tell("silent", now) for now in range(0, 2 * int(REPEAT_LOG_S) + 1, 5)]
    per_time = int(REPEAT_LOG_S) // 5
    assert [n for n in times if n] == [1, per_time, per_time]


def test_causes_are_not_told_apart_by_numbers_and_their_number_is_bounded() -> None:
    told = LogLimiter()
    assert [told.tell(f"TEC {n}", 0) for n in range(3)] == [1, None, None]
    texts = [f"{a}{b}" for a in string.ascii_letters for b in string.ascii_letters]
    assert sum(told.tell(text, 1) is not None for text in texts) == CAUSES_MAX
    assert len(told._causes) == CAUSES_MAX + 1
    assert told.tell("all others are forgotten by then", 3 * REPEAT_LOG_S) == 1
    assert len(told._causes) == 1


def test_an_interval_between_two_lines_of_a_cause() -> None:
    told = LogLimiter(interval_s=10.0)
    times = []
    for now in (0, 5, 9, 10, 19, 20):
        times.append(told.tell("noise", now))
        told.well()
    assert times == [1, None, None, 3, None, 2]
