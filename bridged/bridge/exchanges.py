"""Questions to the adapter of one bridge and their answers: one by one, or as the steps of a procedure."""

from __future__ import annotations

import itertools
import time
from typing import TYPE_CHECKING, TypeAlias

from bridged import _relay
from bridged.adapters.base import Answer, Reply
from bridged.bridge.health import Finding
from bridged.bridge.lifecycle import Event, Verdict
from bridged.errors import AdapterError, WrongDeviceError

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged.adapters.base import Exchange, Steps

REPLIES = {
    _relay.EVENT_OK: Reply.OK,
    _relay.EVENT_REFUSED: Reply.REFUSED,
    _relay.EVENT_TEXT: Reply.TEXT,
    _relay.EVENT_TIMEOUT: Reply.NONE,
}


Found: TypeAlias = Finding | Verdict | None
"""What an answer leads to; None: nothing, or another question."""


class Exchanges:
    """Sends questions by the relay; the owner hands it the relay's events with a kind in REPLIES.

    A method that ends a procedure returns how: the event that run() was called with, REFUSED or UNANSWERED.
    """

    def __init__(self, relay: _relay.Relay) -> None:
        self._relay = relay
        self._tokens = itertools.count(1)
        self._pending: dict[int, Callable[[Answer], Found]] = {}
        self._steps: Steps | None = None
        self._end = Event.CLOSED
        self._last_reply = Reply.NONE  # to a step of a procedure
        # Whether the adapter's channel may be open, as far as its answers tell; None: it was never asked.
        self.channel_open: bool | None = None
        self.next_at: float | None = None  # the end of a pause between two steps, time.monotonic()

    @property
    def running(self) -> bool:
        """Whether a procedure is under way."""
        return self._steps is not None

    def ask(self, exchange: Exchange, then: Callable[[Answer], Found], more: bool = False) -> None:
        """`then` gets the answer, in answer(). `more`: another follows at once, and they go together."""
        if exchange.opens:
            self._relay.set_gates(receiving=True, transmit=_relay.GATE_AWAY)
        token = next(self._tokens) & 0xFFFFFFFF
        self._pending[token] = then
        accepted, rejected = exchange.accept, exchange.reject
        accept = _relay.ACCEPT_OK if Reply.OK in accepted or Reply.OK in rejected else 0
        if Reply.REFUSED in accepted or Reply.REFUSED in rejected:
            accept |= _relay.ACCEPT_REFUSED
        self._relay.command(token, exchange.request, accept, exchange.prefix, exchange.timeout_s, more=more)

    def run(self, steps: Steps, end: Event) -> Verdict | None:
        """Performs the steps one by one; a step that was under way is forgotten, its answer awaited."""
        self.forget()
        if end is Event.READY:
            self.channel_open = True
        self._steps = steps
        self._end = end
        return self._advance(None)

    def answer(self, kind: int, token: int, text: bytes) -> Found:
        """An event of the relay; nothing happens if nobody waits for it any more."""
        then = self._pending.pop(token, None)
        return None if then is None else then(Answer(REPLIES[kind], text))

    def forget(self) -> None:
        """Nobody waits for anything any more."""
        self._steps = None
        self._pending.clear()
        self.next_at = None

    def on_timer(self, now: float) -> Verdict | None:
        if self.next_at is None or self.next_at > now:
            return None
        self.next_at = None
        return self._advance(Answer(Reply.NONE))

    def _advance(self, answer: Answer | None) -> Verdict | None:
        steps = self._steps
        assert steps is not None
        try:
            exchange = steps.send(answer) if answer else next(steps)
        except StopIteration:
            self._steps = None
            if self._end is Event.CLOSED:
                self.channel_open = self._last_reply is Reply.NONE
            return Verdict(self._end)
        except WrongDeviceError as error:
            return Verdict(Event.REFUSED, str(error))
        except AdapterError as error:
            return Verdict(Event.UNANSWERED, str(error))
        if exchange.request:
            self.ask(exchange, lambda reply: self._on_step_answer(exchange, reply))
        else:
            self.next_at = time.monotonic() + exchange.timeout_s
        return None

    def _on_step_answer(self, exchange: Exchange, answer: Answer) -> Verdict | None:
        self._last_reply = answer.reply
        if answer.reply in exchange.accept:
            return self._advance(answer)
        advice = f": {exchange.advice}" if exchange.advice else ""
        if answer.reply is Reply.REFUSED:
            return Verdict(Event.REFUSED, f"the adapter refused to {exchange.purpose}{advice}")
        wait = f"within {exchange.timeout_s:.2g} s"
        return Verdict(
            Event.UNANSWERED, f"the adapter did not answer the request to {exchange.purpose} {wait}"
        )
