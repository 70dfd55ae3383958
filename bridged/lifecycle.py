"""The life of one bridge's adapter as a table: (state, event) -> (state, actions). No I/O, no clock."""

from __future__ import annotations

import enum


class State(enum.Enum):
    """Where the adapter is; the CAN bus state is another matter."""

    IDLE = "idle"  # not started
    OPENING = "opening"  # the port is being opened
    INITIALISING = "initialising"  # the adapter is being identified and configured
    RUNNING = "running"  # frames are relayed
    REJECTING = "rejecting"  # wrong device, or it refuses its configuration; the channel is closed
    CLOSING = "closing"  # something failed; the channel is closed before the next try
    BACKOFF = "backoff"  # waiting before the next try
    FAULT = "fault"  # after REJECTING: tried again slowly
    STOPPING = "stopping"  # told to stop; the channel is being closed
    STOPPED = "stopped"


class Event(enum.Enum):
    START = enum.auto()
    OPENED = enum.auto()
    OPEN_FAILED = enum.auto()
    READY = enum.auto()  # initialised
    UNANSWERED = enum.auto()  # a step of the initialisation had no answer
    REFUSED = enum.auto()  # wrong device, or a refused setting
    SILENT = enum.auto()  # the running adapter answers nothing any more
    PORT_LOST = enum.auto()
    CLOSED = enum.auto()  # the closing steps are done, whatever they met
    TIMER = enum.auto()
    STOP = enum.auto()


class Action(enum.Enum):
    OPEN = enum.auto()  # open the port -> OPENED, OPEN_FAILED
    INITIALISE = enum.auto()  # -> READY, UNANSWERED, REFUSED
    RUN = enum.auto()  # open the gates
    CLOSE = enum.auto()  # close the gates, then the channel -> CLOSED
    RELEASE = enum.auto()  # give the port back
    WAIT = enum.auto()  # -> TIMER
    WAIT_LONG = enum.auto()  # -> TIMER
    FINISH = enum.auto()


S, E, A = State, Event, Action
Transition = tuple[State, tuple[Action, ...]]

TABLE: dict[tuple[State, Event], Transition] = {
    (S.IDLE, E.START): (S.OPENING, (A.OPEN,)),
    (S.IDLE, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.OPENING, E.OPENED): (S.INITIALISING, (A.INITIALISE,)),
    (S.OPENING, E.OPEN_FAILED): (S.BACKOFF, (A.WAIT,)),
    (S.OPENING, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.INITIALISING, E.READY): (S.RUNNING, (A.RUN,)),
    (S.INITIALISING, E.UNANSWERED): (S.CLOSING, (A.CLOSE,)),
    (S.INITIALISING, E.REFUSED): (S.REJECTING, (A.CLOSE,)),
    (S.INITIALISING, E.PORT_LOST): (S.BACKOFF, (A.RELEASE, A.WAIT)),
    (S.INITIALISING, E.STOP): (S.STOPPING, (A.CLOSE,)),
    (S.RUNNING, E.SILENT): (S.CLOSING, (A.CLOSE,)),
    (S.RUNNING, E.PORT_LOST): (S.BACKOFF, (A.RELEASE, A.WAIT)),
    (S.RUNNING, E.STOP): (S.STOPPING, (A.CLOSE,)),
    (S.CLOSING, E.CLOSED): (S.BACKOFF, (A.RELEASE, A.WAIT)),
    (S.CLOSING, E.PORT_LOST): (S.BACKOFF, (A.RELEASE, A.WAIT)),
    (S.CLOSING, E.STOP): (S.STOPPING, (A.CLOSE,)),
    (S.REJECTING, E.CLOSED): (S.FAULT, (A.RELEASE, A.WAIT_LONG)),
    (S.REJECTING, E.PORT_LOST): (S.FAULT, (A.RELEASE, A.WAIT_LONG)),
    (S.REJECTING, E.STOP): (S.STOPPING, (A.CLOSE,)),
    (S.BACKOFF, E.TIMER): (S.OPENING, (A.OPEN,)),
    (S.BACKOFF, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.FAULT, E.TIMER): (S.OPENING, (A.OPEN,)),
    (S.FAULT, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.STOPPING, E.CLOSED): (S.STOPPED, (A.RELEASE, A.FINISH)),
    (S.STOPPING, E.PORT_LOST): (S.STOPPED, (A.RELEASE, A.FINISH)),
    # The port was opened for nothing while the bridge was told to stop.
    (S.STOPPED, E.OPENED): (S.STOPPED, (A.RELEASE,)),
}

# Late news, without meaning for the state they meet.
IGNORED: frozenset[tuple[State, Event]] = frozenset(
    [(S.CLOSING, E.SILENT), (S.REJECTING, E.SILENT), (S.STOPPING, E.SILENT), (S.STOPPING, E.STOP)]
    + [(S.BACKOFF, E.PORT_LOST), (S.FAULT, E.PORT_LOST)]  # came with the news that ended it
    + [(S.STOPPED, event) for event in (E.STOP, E.OPEN_FAILED, E.PORT_LOST)]
)


def transition(state: State, event: Event) -> Transition:
    """What `event` means in `state`. KeyError is a bug: the two cannot meet."""
    if (state, event) in IGNORED:
        return state, ()
    return TABLE[state, event]


class Backoff:
    """Seconds until the next try: doubling from `initial_s` to `maximum_s` until reset()."""

    def __init__(self, initial_s: float, maximum_s: float) -> None:
        self._initial_s = initial_s
        self._maximum_s = maximum_s
        self._next_s = initial_s

    def next_s(self) -> float:
        delay = self._next_s
        self._next_s = min(self._maximum_s, 2 * delay)
        return delay

    def reset(self) -> None:
        self._next_s = self._initial_s
