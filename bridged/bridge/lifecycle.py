"""The life of one bridge's adapter as a table: (state, event) -> (state, actions). No I/O, no clock."""

from __future__ import annotations

import enum
from typing import NamedTuple


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
    RESTART = enum.auto()  # the interface came up: whoever did that wants the bus back
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
    HURRY = enum.auto()  # pauses are short again
    FINISH = enum.auto()


S, E, A = State, Event, Action
Transition = tuple[State, tuple[Action, ...]]

TABLE: dict[tuple[State, Event], Transition] = {
    (S.IDLE, E.START): (S.OPENING, (A.OPEN,)),
    (S.IDLE, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.WAITING, E.APPEARED): (S.OPENING, (A.HURRY, A.OPEN)),
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
    (S.BACKOFF, E.APPEARED): (S.OPENING, (A.HURRY, A.OPEN)),
    (S.BACKOFF, E.STOP): (S.STOPPED, (A.FINISH,)),
    (S.FAULT, E.TIMER): (S.OPENING, (A.OPEN,)),
    (S.FAULT, E.APPEARED): (S.OPENING, (A.HURRY, A.OPEN)),
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
