"""Procedures of questions and pauses; test_bridge.py has them with an adapter."""

import math

from bridged.adapters.base import Reply, Steps, pause
from bridged.bridge.exchanges import Exchanges
from bridged.bridge.lifecycle import Event


def paused() -> tuple[Exchanges, list[Event]]:
    """In a pause, and how procedures have ended."""
    ends: list[Event] = []
    exchanges = Exchanges(None, lambda verdict: ends.append(verdict.event))  # type: ignore[arg-type]

    def steps() -> Steps:
        answer = yield pause(3600.0)
        assert answer.reply is Reply.NONE

    exchanges.run(steps(), Event.CLOSED)
    return exchanges, ends


def test_a_pause_ends_the_procedure_when_its_time_has_come() -> None:
    exchanges, ends = paused()
    assert exchanges.next_at is not None
    exchanges.on_timer(exchanges.next_at - 1)
    assert ends == []
    exchanges.on_timer(exchanges.next_at)
    assert (ends, exchanges.next_at) == ([Event.CLOSED], None)


def test_a_pause_that_is_forgotten_ends_nothing() -> None:
    """As when the port is lost in it."""
    exchanges, ends = paused()
    exchanges.forget()
    exchanges.on_timer(math.inf)
    assert (ends, exchanges.next_at) == ([], None)
