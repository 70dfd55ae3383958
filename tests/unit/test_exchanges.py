"""Procedures of questions and pauses; the tests of the bridge have them with an adapter."""

import math

from bridged.adapters.base import Reply, Steps, pause
from bridged.bridge.exchanges import Exchanges
from bridged.bridge.lifecycle import Event, Verdict


def paused() -> Exchanges:
    """In a pause."""
    exchanges = Exchanges(None)  # type: ignore[arg-type]

    def steps() -> Steps:
        answer = yield pause(3600.0)
        assert answer.reply is Reply.NONE

    assert exchanges.run(steps(), Event.CLOSED) is None
    return exchanges


def test_a_pause_ends_the_procedure_when_its_time_has_come() -> None:
    exchanges = paused()
    assert exchanges.next_at is not None
    assert exchanges.on_timer(exchanges.next_at - 1) is None
    assert exchanges.on_timer(exchanges.next_at) == Verdict(Event.CLOSED)
    assert exchanges.next_at is None


def test_a_pause_that_is_forgotten_ends_nothing() -> None:
    """As when the port is lost in it."""
    exchanges = paused()
    exchanges.forget()
    assert exchanges.on_timer(math.inf) is None
    assert exchanges.next_at is None
