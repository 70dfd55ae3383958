"""Procedures of questions and pauses; the tests of the bridge have them with an adapter."""

import math
from types import SimpleNamespace
from typing import Any

from bridged import _relay
from bridged.adapters.base import Exchange, Reply, Steps, pause
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


def test_frames_are_wanted_before_the_step_that_opens_the_channel_is_sent() -> None:
    """The first of them may come with its answer."""
    said: list[object] = []
    relay: Any = SimpleNamespace(
        set_gates=lambda *, receiving, transmit: said.append((receiving, transmit)),
        command=lambda _token, request, *_rest, more: said.append((request, more)),
    )
    exchanges = Exchanges(relay)

    def steps() -> Steps:
        yield Exchange(b"S4", "set", (Reply.OK,))
        yield Exchange(b"O", "open", (Reply.OK,), opens=True)

    exchanges.run(steps(), Event.READY)
    assert said == [(b"S4", False)]
    exchanges.answer(_relay.EVENT_OK, 1, b"")
    assert said[1:] == [(True, _relay.GATE_AWAY), (b"O", False)]
