"""The lifecycle's table: every pair, and what must hold of all of them."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridged.lifecycle import IGNORED, TABLE, Action, Backoff, Event, State, transition

# Events that a state can meet, and no others. RELEASE drops what the relay still had to say.
POSSIBLE = {
    State.IDLE: {Event.START, Event.STOP},
    State.OPENING: {Event.OPENED, Event.OPEN_FAILED, Event.STOP},
    State.INITIALISING: {Event.READY, Event.UNANSWERED, Event.REFUSED, Event.PORT_LOST, Event.STOP},
    State.RUNNING: {Event.SILENT, Event.PORT_LOST, Event.STOP},
    State.REJECTING: {Event.CLOSED, Event.SILENT, Event.PORT_LOST, Event.STOP},
    State.CLOSING: {Event.CLOSED, Event.SILENT, Event.PORT_LOST, Event.STOP},
    State.BACKOFF: {Event.TIMER, Event.PORT_LOST, Event.STOP},
    State.FAULT: {Event.TIMER, Event.PORT_LOST, Event.STOP},
    State.STOPPING: {Event.CLOSED, Event.SILENT, Event.PORT_LOST, Event.STOP},
    State.STOPPED: {Event.OPENED, Event.OPEN_FAILED, Event.PORT_LOST, Event.STOP},
}


@pytest.mark.parametrize(("state", "event"), list(itertools.product(State, Event)))
def test_every_pair_is_decided(state: State, event: Event) -> None:
    if event not in POSSIBLE[state]:
        with pytest.raises(KeyError):
            transition(state, event)
        return
    after, actions = transition(state, event)
    if (state, event) in IGNORED:
        assert (after, actions) == (state, ())
    elif after is not state:
        assert actions


def test_ignored_and_decided_do_not_overlap() -> None:
    assert not IGNORED & TABLE.keys()


@given(st.data())
def test_random_walks_keep_what_must_hold(data: st.DataObject) -> None:
    state, port_open, gates_open, waiting = State.IDLE, False, False, False
    for _ in range(60):
        possible = POSSIBLE[state] - ({Event.TIMER} if not waiting else set())
        if state is State.STOPPED and port_open:
            possible -= {Event.OPENED}
        event = data.draw(st.sampled_from(sorted(possible, key=lambda e: e.name)))
        port_open = port_open or event is Event.OPENED
        state, actions = transition(state, event)
        waiting = waiting and not actions
        for action in actions:
            if action is Action.RUN:
                gates_open = True
            elif action in {Action.CLOSE, Action.RELEASE, Action.FINISH}:
                gates_open = False
            if action is Action.RELEASE:
                port_open = False
            if action is Action.OPEN:
                assert not port_open
            waiting = action in {Action.WAIT, Action.WAIT_LONG}
        assert gates_open == (state is State.RUNNING)
        assert not (state in {State.BACKOFF, State.FAULT, State.STOPPED} and port_open)
        assert (state in {State.BACKOFF, State.FAULT}) == waiting or state is State.STOPPED


def test_backoff_doubles_to_its_maximum_and_starts_again() -> None:
    backoff = Backoff(0.1, 1.0)
    assert [backoff.next_s() for _ in range(5)] == [0.1, 0.2, 0.4, 0.8, 1.0]
    backoff.reset()
    assert backoff.next_s() == 0.1
