"""Rates and answer times of one bridge."""

import pytest

from bridged.bridge.figures import ANSWER_TIMES, Figures


def test_rates_are_those_of_the_last_second() -> None:
    figures = Figures()
    assert figures.rates() == {"rx_fps": 0.0, "tx_fps": 0.0}
    for n in range(20):  # 100 frames a second, and no more after two seconds
        figures.sample(n / 5, 20 * min(n, 10), 10 * min(n, 10))
        if n == 10:
            assert figures.rates() == {"rx_fps": 100.0, "tx_fps": 50.0}
    assert figures.rates() == {"rx_fps": 0.0, "tx_fps": 0.0}


def test_nothing_is_known_of_rates_while_the_adapter_is_away() -> None:
    figures = Figures()
    figures.sample(0.0, 0, 0)
    figures.sample(1.0, 10, 10)
    figures.forget_rates()
    figures.sample(100.0, 10, 10)
    assert figures.rates()["rx_fps"] == 0.0


@pytest.mark.parametrize("before", [0, ANSWER_TIMES])
def test_only_the_last_answers_count(before: int) -> None:
    figures = Figures()
    assert figures.answer_times_ms() is None
    for _ in range(before):
        figures.answered(60.0)
    for n in range(ANSWER_TIMES):
        figures.answered((n + 1) / 1000)
    assert figures.answer_times_ms() == {"min": 1.0, "median": ANSWER_TIMES / 2 + 1, "max": ANSWER_TIMES}
