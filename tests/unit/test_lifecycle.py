"""The lifecycle's table, pair by pair; and the whole in simulated time."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from bridged.bridge.backoff import JITTER, STABLE_S
from bridged.bridge.lifecycle import (
    IGNORED,
    STOP_S,
    TABLE,
    Action,
    Event,
    Lifecycle,
    State,
    Verdict,
    transition,
)
from bridged.settings import ReconnectConfig

# Events that a state can meet, and no others: RELEASE drops what the relay still had to say, a timer is set
# in four states only, and nobody looks out for the device before the start.
ALWAYS = {Event.STOP, Event.APPEARED, Event.RESTART}
FAILED = {Event.PORT_LOST, Event.SILENT, Event.BUS_OFF}
POSSIBLE = {
    State.IDLE: {Event.START, Event.STOP, Event.RESTART},
    State.WAITING: ALWAYS | {Event.TIMER},
    State.OPENING: ALWAYS | {Event.OPENED, Event.ABSENT, Event.OPEN_FAILED},
    State.INITIALISING: ALWAYS | {Event.READY, Event.UNANSWERED, Event.REFUSED, Event.PORT_LOST},
    State.RUNNING: ALWAYS | FAILED,
    State.REJECTING: ALWAYS | FAILED | {Event.CLOSED},
    State.CLOSING: ALWAYS | FAILED | {Event.CLOSED},
    State.LEAVING: ALWAYS | FAILED | {Event.CLOSED},
    State.BACKOFF: ALWAYS | FAILED | {Event.TIMER},
    State.FAULT: ALWAYS | FAILED | {Event.TIMER},
    State.BUS_OFF: ALWAYS | FAILED,
    State.STOPPING: ALWAYS | FAILED | {Event.CLOSED, Event.TIMER},
    State.STOPPED: ALWAYS | FAILED | {Event.OPENED, Event.ABSENT, Event.OPEN_FAILED},
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
        assert actions or (state, after) == (State.LEAVING, State.CLOSING)


def test_ignored_and_decided_do_not_overlap() -> None:
    assert not IGNORED & TABLE.keys()


@pytest.mark.parametrize("state", [state for state in State if state is not State.STOPPED])
def test_stop_leads_to_the_end(state: State) -> None:
    after, actions = transition(state, Event.STOP)
    if after is State.STOPPING:
        for event in (Event.CLOSED, Event.PORT_LOST):
            assert transition(after, event) == (State.STOPPED, (Action.RELEASE, Action.FINISH))
        assert Action.LIMIT in actions or state is State.STOPPING  # however long the adapter takes
        after, actions = transition(after, Event.TIMER)
        assert (after, actions[-2:]) == (State.STOPPED, (Action.RELEASE, Action.FINISH))
    else:
        assert (after, actions) == (State.STOPPED, (Action.FINISH,))


# --- the whole, in simulated time -------------------------------------------------------------

OPEN_S, STEP_S, SILENCE_S = 0.01, 0.05, 0.5
INITIAL_S, MAXIMUM_S = 0.1, 5.0
TIMED = {Action.LOOK, Action.WAIT, Action.WAIT_LONG, Action.LIMIT}


class World(RuleBasedStateMachine):
    """A device that comes and goes, and a bridge that performs the actions as bridge.py does."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.jitter = 0.0
        reconnect = ReconnectConfig(initial_s=INITIAL_S, maximum_s=MAXIMUM_S)
        self.life = Lifecycle(reconnect, lambda: self.jitter)
        # The world.
        self.present, self.openable, self.answers, self.right = True, True, True, True
        # The bridge: what is set to happen and when, beside the timer of its life; only one of each.
        self.result: tuple[float, Event] | None = None  # of opening, initialising, closing
        self.opening = self.port_open = self.gates_open = self.finished = self.looking_out = False
        self.tries: list[float] = []
        self.pushed = False
        self.dispatch(Event.START)

    # The bridge

    @property
    def state(self) -> State:
        return self.life.state

    def dispatch(self, event: Event) -> None:
        before = self.state
        assert event in POSSIBLE[before], (before, event)
        actions = self.life.take(Verdict(event))
        if self.state is not before:
            self.life.log_change("", self.now)
        for action in actions:
            if action in TIMED:
                assert self.life.next_at is None, "two timers"
            self.life.schedule(action, self.now)
            getattr(self, f"do_{action.name.lower()}")()

    def do_look(self) -> None:
        self.do_wait()
        if self.present:
            self.pushed = True
            self.dispatch(Event.APPEARED)

    def do_open(self) -> None:
        assert not self.port_open
        assert not self.opening
        assert self.life.next_at is None
        self.looking_out, self.opening = False, True
        # By itself it does not hammer; news of the device may have it try at once.
        assert self.pushed or not self.tries or self.now - self.tries[-1] >= (1 - JITTER) * INITIAL_S
        self.pushed = False
        self.tries.append(self.now)
        self.result = self.now + OPEN_S, Event.OPENED  # what came of it is seen then

    def do_initialise(self) -> None:
        assert self.port_open
        self.result = self.now + STEP_S, Event.READY

    def do_run(self) -> None:
        self.gates_open = True

    def do_close(self) -> None:
        assert self.port_open
        self.gates_open = False
        slow = self.state is State.STOPPING and not self.answers
        self.result = self.now + (10 * STOP_S if slow else STEP_S), Event.CLOSED

    def do_limit(self) -> None:
        assert self.life.next_at == self.now + STOP_S

    def do_last_words(self) -> None:
        assert self.port_open

    def do_release(self) -> None:
        self.port_open = self.gates_open = False
        self.result = None

    def do_wait(self) -> None:
        assert self.life.next_at is not None
        assert (1 - JITTER) * INITIAL_S - 1e-6 <= self.life.next_at - self.now <= MAXIMUM_S + 1e-6
        self.looking_out = True

    def do_wait_long(self) -> None:
        self.do_wait()

    def do_shorten_pauses(self) -> None:
        pass

    def do_finish(self) -> None:
        assert not self.port_open
        self.finished, self.looking_out = True, False

    # What happens to it

    def finish_opening(self) -> None:
        self.opening = False
        self.result = None
        if not self.present:
            self.dispatch(Event.ABSENT)
        elif not self.openable:
            self.dispatch(Event.OPEN_FAILED)
        else:
            self.port_open = True
            self.dispatch(Event.OPENED)

    def finish_steps(self, event: Event) -> None:
        self.result = None
        if event is Event.READY and not self.answers:
            event = Event.UNANSWERED
        elif event is Event.READY and not self.right:
            event = Event.REFUSED
        self.dispatch(event)

    def step(self, end: float) -> None:
        """To the next thing that is due, or to the end."""
        due = [
            at for at in (self.life.next_at, self.result and self.result[0]) if at is not None and at <= end
        ]
        if not due:
            if self.state is State.RUNNING and not self.answers and end - self.now >= SILENCE_S:
                self.dispatch(Event.SILENT)
            self.now = end
            return
        self.now = max(self.now, min(due))
        if self.life.has_timed_out(self.now):
            self.dispatch(Event.TIMER)
        elif self.result is not None:
            if self.opening:
                self.finish_opening()
            else:
                self.finish_steps(self.result[1])

    def pass_time(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.step(end)

    @rule(seconds=st.sampled_from([0.001, 0.02, 0.1, 0.7, 3.0, 70.0]), jitter=st.floats(0, 1))
    def time_passes(self, seconds: float, jitter: float) -> None:
        self.jitter = jitter
        self.pass_time(seconds)

    @rule()
    @precondition(lambda self: self.present)
    def pull_out(self) -> None:
        self.present = False
        if self.port_open:
            self.dispatch(Event.PORT_LOST)

    @rule(openable=st.booleans(), right=st.booleans())
    @precondition(lambda self: not self.present)
    def plug_in(self, openable: bool, right: bool) -> None:
        """Perhaps another device, or one that udev has not seen to yet."""
        self.present, self.openable, self.right = True, openable, right
        if self.looking_out:
            self.pushed = True
            self.dispatch(Event.APPEARED)
            assert self.opening, "at once"

    @rule()
    @precondition(lambda self: not self.openable and self.present)
    def udev_is_done(self) -> None:
        self.openable = True
        if self.looking_out:
            self.pushed = True
            self.dispatch(Event.APPEARED)

    @rule()
    def fall_silent_or_speak(self) -> None:
        self.answers = not self.answers

    @rule()
    @precondition(lambda self: self.state is State.RUNNING)
    def reset_behind_our_back(self) -> None:
        self.dispatch(Event.SILENT)

    @rule()
    @precondition(lambda self: self.state is State.RUNNING)
    def bus_off_and_not_to_be_restarted(self) -> None:
        self.dispatch(Event.BUS_OFF)

    @rule()
    def interface_comes_up(self) -> None:
        self.pushed = self.pushed or self.state is State.BUS_OFF
        self.dispatch(Event.RESTART)

    @rule(late=st.sampled_from([Event.APPEARED, Event.STOP]))
    @precondition(lambda self: self.state in {State.STOPPING, State.STOPPED})
    def late_news(self, late: Event) -> None:
        self.dispatch(late)

    @rule()
    @precondition(lambda self: self.state not in {State.STOPPING, State.STOPPED})
    def stop(self) -> None:
        self.dispatch(Event.STOP)

    # What must hold

    @invariant()
    def one_thing_at_a_time(self) -> None:
        pausing = self.state in {State.WAITING, State.BACKOFF, State.FAULT}
        assert pausing == self.looking_out
        assert (self.life.next_at is not None) == (pausing or self.state is State.STOPPING)
        assert self.gates_open == (self.state is State.RUNNING)
        assert self.opening == (self.state is State.OPENING) or self.finished
        closed = {State.IDLE, State.OPENING, State.WAITING, State.BACKOFF, State.FAULT, State.BUS_OFF}
        assert not (self.state in closed and self.port_open)
        assert self.finished == (self.state is State.STOPPED)

    def teardown(self) -> None:
        """Whatever happened: with a good device it runs within the longest pause, and it can be stopped."""
        if not self.finished and self.state is not State.STOPPING:
            self.present = self.openable = self.answers = self.right = True
            self.interface_comes_up()
            self.pass_time(MAXIMUM_S + 2 * (OPEN_S + 2 * STEP_S))
            assert self.state is State.RUNNING, self.state
            self.dispatch(Event.STOP)
        self.pass_time(STOP_S)
        assert self.finished


TestWorld = World.TestCase


def test_a_device_that_is_away_is_not_tried_at_all() -> None:
    """An hour without it costs no try and few looks; one that does not answer, a try every five seconds."""
    world = World()
    world.pass_time(10.0)
    assert world.state is State.RUNNING
    world.pull_out()
    world.pass_time(3600.0)
    assert (world.state, len(world.tries)) == (State.WAITING, 2)
    world.plug_in(openable=True, right=True)
    world.answers = False
    world.pass_time(3600.0)
    assert 700 < len(world.tries) < 750


def test_a_device_whose_permissions_come_late_is_tried_quickly() -> None:
    world = World()
    world.pull_out()
    world.pass_time(100.0)
    world.plug_in(openable=False, right=True)
    before = len(world.tries)
    world.pass_time(0.5)
    assert len(world.tries) - before >= 2
    world.openable = True
    world.pass_time(1.0)
    assert world.state is State.RUNNING


def running() -> Lifecycle:
    """Since 100 s; the pauses are INITIAL_S at first, without jitter."""
    life = Lifecycle(ReconnectConfig(initial_s=INITIAL_S, maximum_s=MAXIMUM_S), lambda: 0.0)
    for event in (Event.START, Event.OPENED, Event.READY):
        for action in life.take(Verdict(event)):
            life.schedule(action, 100.0)
    return life


@pytest.mark.parametrize(("pause_s", "waits_s"), [(None, INITIAL_S), (2.5, 2.5)])
def test_what_ended_a_run_may_say_how_long_the_pause_is(pause_s: float | None, waits_s: float) -> None:
    life = running()
    life.take(Verdict(Event.SILENT, "bus-off", pause_s, off_bus=True))
    assert life.is_restart
    life.take(Verdict(Event.CLOSED))
    life.schedule(Action.WAIT, 200.0)
    assert life.next_at == 200.0 + waits_s
    assert not life.has_timed_out(200.0)
    assert life.has_timed_out(200.0 + waits_s)
    assert life.next_at is None


def test_only_a_run_that_ended_in_bus_off_is_followed_by_a_restart() -> None:
    life = running()
    life.take(Verdict(Event.SILENT, "bus-off", off_bus=True))
    for event in (Event.CLOSED, Event.TIMER, Event.OPENED, Event.READY):
        life.take(Verdict(event))
    assert life.is_restart  # of this run: the interface is told
    life.take(Verdict(Event.PORT_LOST, "unplugged"))
    assert not life.is_restart


def test_other_pauses_shorten_the_one_that_is_under_way() -> None:
    life = running()
    life.take(Verdict(Event.PORT_LOST, "unplugged", 60.0))
    life.schedule(Action.WAIT, 200.0)
    life.reconfigure(ReconnectConfig(initial_s=1.0, maximum_s=9.0), 210.0)
    assert life.next_at == 211.0
    life.reconfigure(ReconnectConfig(initial_s=3.0, maximum_s=9.0), 210.0)
    assert life.next_at == 211.0


@pytest.mark.parametrize(("ran_s", "waits_s"), [(STABLE_S, INITIAL_S), (STABLE_S - 1, 4 * INITIAL_S)])
def test_a_long_run_makes_the_pause_after_it_short(ran_s: float, waits_s: float) -> None:
    life = running()
    for _ in range(2):
        life.schedule(Action.WAIT, 100.0)
    life.schedule(Action.RUN, 100.0)
    life.take(Verdict(Event.PORT_LOST, "unplugged"))
    life.schedule(Action.WAIT, 100.0 + ran_s)
    assert life.next_at == 100.0 + ran_s + waits_s
