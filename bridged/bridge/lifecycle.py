"""The life of one bridge's adapter: a table (state, event) -> (state, actions), its pauses, its log lines.

No I/O, no clock: the time is passed in.
"""

from __future__ import annotations

import enum
import logging
from typing import TYPE_CHECKING, NamedTuple

from bridged.bridge.backoff import Backoff, chance
from bridged.bridge.log_limiter import LogLimiter, repeated

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged.settings import ReconnectConfig

log = logging.getLogger(__name__)

STOP_S = 1.2  # for an adapter that does not answer; systemd and users wait for the end


class State(enum.Enum):
    """Where the adapter is; the CAN bus state is another matter.

    There is no `recovering` on the open port: CLOSING and a port opened anew also cure a stuck tty or chip.
    """

    IDLE = "idle"  # not started
    WAITING = "waiting"  # there is no such device: nothing to open until it comes
    OPENING = "opening"  # the port is being opened
    INITIALISING = "initialising"  # the adapter is being identified and configured
    RUNNING = "running"  # frames are relayed
    REJECTING = "rejecting"  # wrong device, or it refuses its configuration; the channel is closed
    CLOSING = "closing"  # something failed; the channel is closed before the next try
    BACKOFF = "backoff"  # a pause before the next try
    FAULT = "fault"  # after REJECTING: tried again slowly
    LEAVING = "leaving"  # bus-off, and not to be restarted; the channel is being closed
    BUS_OFF = "bus-off"  # after LEAVING: until somebody restarts it
    STOPPING = "stopping"  # told to stop; the channel is being closed
    STOPPED = "stopped"


class Event(enum.Enum):
    START = enum.auto()
    APPEARED = enum.auto()  # the device was plugged in
    OPENED = enum.auto()
    ABSENT = enum.auto()  # not opened: there is no such device
    OPEN_FAILED = enum.auto()  # not opened for any other reason
    READY = enum.auto()  # initialised
    UNANSWERED = enum.auto()  # a step of the initialisation had no answer
    REFUSED = enum.auto()  # wrong device, or a refused setting
    SILENT = enum.auto()  # the running adapter answers nothing any more, or must begin anew
    BUS_OFF = enum.auto()  # and must not be restarted
    RESTART = enum.auto()  # the interface came up: whoever did that wants it to carry frames
    PORT_LOST = enum.auto()
    CLOSED = enum.auto()  # the closing steps are done, whatever they met
    TIMER = enum.auto()
    STOP = enum.auto()


class Verdict(NamedTuple):
    """An event and its data: what a part of the bridge found, for bridge.py to act on."""

    event: Event
    reason: str = ""
    pause_s: float | None = None  # before the next try; None: the back-off decides
    off_bus: bool = False  # the adapter leaves its CAN bus because of bus-off: its next run is a restart


class Action(enum.Enum):
    LOOK = enum.auto()  # is the device there? -> APPEARED, or later TIMER or APPEARED
    OPEN = enum.auto()  # open the port -> OPENED, ABSENT, OPEN_FAILED
    INITIALISE = enum.auto()  # -> READY, UNANSWERED, REFUSED
    RUN = enum.auto()  # open the gates
    CLOSE = enum.auto()  # close the gates, then the channel -> CLOSED
    LIMIT = enum.auto()  # nobody waits longer for the end -> TIMER
    LAST_WORDS = enum.auto()  # close the channel without awaiting answers
    RELEASE = enum.auto()  # give the port back
    WAIT = enum.auto()  # -> TIMER, or APPEARED if the device is plugged in anew before
    WAIT_LONG = enum.auto()  # the same
    SHORTEN_PAUSES = enum.auto()  # they are as short as after the start
    FINISH = enum.auto()


S, E, A = State, Event, Action
Transition = tuple[State, tuple[Action, ...]]

TABLE: dict[tuple[State, Event], Transition] = {
    (S.IDLE, E.START): (S.OPENING, (A.OPEN,)),
    (S.IDLE, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.WAITING, E.APPEARED): (S.OPENING, (A.SHORTEN_PAUSES, A.OPEN)),
    (S.WAITING, E.TIMER): (S.WAITING, (A.LOOK,)),
    (S.WAITING, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.OPENING, E.OPENED): (S.INITIALISING, (A.INITIALISE,)),
    (S.OPENING, E.ABSENT): (S.WAITING, (A.LOOK,)),
    (S.OPENING, E.OPEN_FAILED): (S.BACKOFF, (A.WAIT,)),
    (S.OPENING, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.INITIALISING, E.READY): (S.RUNNING, (A.RUN,)),
    (S.INITIALISING, E.UNANSWERED): (S.CLOSING, (A.CLOSE,)),
    (S.INITIALISING, E.REFUSED): (S.REJECTING, (A.CLOSE,)),
    (S.INITIALISING, E.PORT_LOST): (S.BACKOFF, (A.RELEASE, A.WAIT)),
    (S.INITIALISING, E.STOP): (S.STOPPING, (A.LIMIT, A.CLOSE)),
    (S.RUNNING, E.SILENT): (S.CLOSING, (A.CLOSE,)),
    (S.RUNNING, E.PORT_LOST): (S.BACKOFF, (A.RELEASE, A.WAIT)),
    (S.RUNNING, E.BUS_OFF): (S.LEAVING, (A.CLOSE,)),
    (S.RUNNING, E.STOP): (S.STOPPING, (A.LIMIT, A.CLOSE)),
    (S.CLOSING, E.CLOSED): (S.BACKOFF, (A.RELEASE, A.WAIT)),
    (S.CLOSING, E.PORT_LOST): (S.BACKOFF, (A.RELEASE, A.WAIT)),
    (S.CLOSING, E.STOP): (S.STOPPING, (A.LIMIT, A.CLOSE)),
    (S.REJECTING, E.CLOSED): (S.FAULT, (A.RELEASE, A.WAIT_LONG)),
    (S.REJECTING, E.PORT_LOST): (S.FAULT, (A.RELEASE, A.WAIT_LONG)),
    (S.REJECTING, E.STOP): (S.STOPPING, (A.LIMIT, A.CLOSE)),
    (S.LEAVING, E.CLOSED): (S.BUS_OFF, (A.RELEASE,)),
    (S.LEAVING, E.PORT_LOST): (S.BUS_OFF, (A.RELEASE,)),
    (S.LEAVING, E.RESTART): (S.CLOSING, ()),
    (S.LEAVING, E.STOP): (S.STOPPING, (A.LIMIT, A.CLOSE)),
    (S.BUS_OFF, E.RESTART): (S.OPENING, (A.OPEN,)),
    (S.BUS_OFF, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.BACKOFF, E.TIMER): (S.OPENING, (A.OPEN,)),
    (S.BACKOFF, E.APPEARED): (S.OPENING, (A.SHORTEN_PAUSES, A.OPEN)),
    (S.BACKOFF, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.FAULT, E.TIMER): (S.OPENING, (A.OPEN,)),
    (S.FAULT, E.APPEARED): (S.OPENING, (A.SHORTEN_PAUSES, A.OPEN)),
    (S.FAULT, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.STOPPING, E.CLOSED): (S.STOPPED, (A.RELEASE, A.FINISH)),
    (S.STOPPING, E.PORT_LOST): (S.STOPPED, (A.RELEASE, A.FINISH)),
    (S.STOPPING, E.TIMER): (S.STOPPED, (A.LAST_WORDS, A.RELEASE, A.FINISH)),
    # The port was opened for nothing while the bridge was told to stop.
    (S.STOPPED, E.OPENED): (S.STOPPED, (A.RELEASE,)),
}

# Late news, without meaning for the state they meet.
IGNORED: frozenset[tuple[State, Event]] = frozenset(
    [(S.STOPPING, E.STOP)]
    + [
        (state, event)
        for state in (S.CLOSING, S.REJECTING, S.LEAVING, S.STOPPING)
        for event in (E.SILENT, E.BUS_OFF)
    ]
    # They came with the news that ended it.
    + [
        (state, event)
        for state in (S.BACKOFF, S.FAULT, S.BUS_OFF)
        for event in (E.PORT_LOST, E.SILENT, E.BUS_OFF)
    ]
    + [(S.STOPPED, event) for event in (E.STOP, E.ABSENT, E.OPEN_FAILED, E.PORT_LOST, E.SILENT, E.BUS_OFF)]
    # Only what is bus-off waits for it.
    + [(state, E.RESTART) for state in S if state not in {S.LEAVING, S.BUS_OFF}]
    # Only WAITING, BACKOFF and FAULT look out for the device; the news may be on its way when they end.
    + [(state, E.APPEARED) for state in S if state not in {S.IDLE, S.WAITING, S.BACKOFF, S.FAULT}]
)


def transition(state: State, event: Event) -> Transition:
    """What `event` means in `state`. KeyError is a bug: the two cannot meet."""
    if (state, event) in IGNORED:
        return state, ()
    return TABLE[state, event]


# States before the adapter runs for the first time.
COMING_UP = (S.IDLE, S.OPENING, S.INITIALISING)
# States that end at once when the device is plugged in.
AWAITING_DEVICE = (S.WAITING, S.BACKOFF, S.FAULT)
# States entered because the adapter failed.
FAILING = (S.CLOSING, S.REJECTING)
# States that keep showing the reason of the failure before.
KEEPING_REASON = (*AWAITING_DEVICE, S.BUS_OFF)


class Lifecycle:
    """The state of one bridge's adapter, why it is in it, and when the next try is due.

    The owner performs the actions that take() returns, in order, each together with schedule(), and calls
    take() with TIMER when `next_at` has come. Times are seconds of any clock; `random` gives 0 to 1.
    """

    def __init__(self, reconnect: ReconnectConfig, random: Callable[[], float] = chance) -> None:
        self.state = State.IDLE
        self.reason = ""  # why the state is not running
        self.next_at: float | None = None
        self.is_restart = False  # the adapter left its CAN bus because of bus-off when it ran last
        self._backoff = Backoff(reconnect.initial_s, reconnect.maximum_s, random)
        self._pause_s: float | None = None  # before the next try, if the back-off does not decide
        self._log_limiter = LogLimiter()

    def reconfigure(self, reconnect: ReconnectConfig, now: float) -> None:
        """Goes on with other pauses; one that is under way becomes shorter, if at all."""
        self._backoff.reconfigure(reconnect.initial_s, reconnect.maximum_s)
        if self.state in AWAITING_DEVICE and self.next_at is not None:
            self.next_at = min(self.next_at, now + self._backoff.next_s(now))

    def take(self, verdict: Verdict) -> tuple[Action, ...]:
        """Enters the state that the event leads to. If that is another one, log_change() is to follow."""
        before = self.state
        self.state, actions = transition(before, verdict.event)
        if before in {State.RUNNING, State.OPENING} and self.state is not before:
            self._pause_s = verdict.pause_s
        if before is State.RUNNING and self.state is not before:
            self.is_restart = verdict.off_bus
        return actions

    def schedule(self, action: Action, now: float) -> None:
        """Sets or clears `next_at`, if that is what the action is for."""
        match action:
            case Action.LOOK:  # again now and then: what is no device of the kernel's (a pty) has no event
                self.next_at = now + self._backoff.next_s(now)
            case Action.WAIT:
                self.next_at = now + (self._backoff.next_s(now) if self._pause_s is None else self._pause_s)
            case Action.WAIT_LONG:
                self.next_at = now + self._backoff.longest_s()
            case Action.LIMIT:
                self.next_at = now + STOP_S
            case Action.OPEN | Action.FINISH:
                self.next_at = None
            case Action.RUN:
                self._backoff.runs(now)
            case Action.SHORTEN_PAUSES:
                self._backoff.reset()

    def has_timed_out(self, now: float) -> bool:
        """Whether TIMER is due. Clears `next_at`."""
        if self.next_at is None or self.next_at > now:
            return False
        self.next_at = None
        return True

    def log_change(self, reason: str, now: float) -> None:
        """One line; retries, and what is repeated too often, for those who look for a fault only."""
        if self.state is State.BUS_OFF:
            reason = f"the bridge has taken the adapter off its CAN bus: {self.reason}"
        self.reason = reason or (self.reason if self.state in KEEPING_REASON else "")
        times = self._log_limiter.should_log(reason, now) if reason else 0
        if times:
            again = ""
            if self.state in {State.CLOSING, State.BACKOFF} and self._pause_s is None:
                again = f"; trying again in {self._backoff.coming_s(now):.2g} s"
            log.warning("state=%s: %s%s%s", self.state.value, reason, again, repeated(times))
            return
        quiet = self._log_limiter.quiet if self.state is State.RUNNING else self._log_limiter.failing
        always = self.state in {State.STOPPING, State.STOPPED, State.BUS_OFF}
        level = logging.DEBUG if quiet and not always else logging.INFO
        log.log(level, "state=%s%s%s", self.state.value, ": " if reason else "", reason)
        if self.state is State.RUNNING:
            self._log_limiter.recovered()
