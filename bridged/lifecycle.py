"""The life of one bridge's adapter as a table: (state, event) -> (state, actions). No I/O, no clock."""

from __future__ import annotations

import enum
import os
import re
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

STABLE_S: Final = 60.0  # the adapter ran so long: what failed before is forgotten
JITTER: Final = 0.2  # a pause is shorter by up to this part, so that many bridges do not try in step
REPEAT_LOG_S: Final = 3600.0  # the same cause is told again
TOLD_AT_MOST: Final = 5  # the same cause within that time
CAUSES_MAX: Final = 32  # what an adapter says may be anything; causes beyond these are told as one


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


def chance() -> float:
    """From 0 to below 1. (The module random is 3 % of the time that the bridge takes to start.)"""
    return int.from_bytes(os.urandom(4)) / 2**32


class Backoff:
    """Seconds until the next try: doubling from `initial_s` to `maximum_s`, each with jitter.

    They are short again after hurry(), and after the adapter ran for STABLE_S: running for a moment only
    is no reason to hurry. `random` gives 0 to 1; `now` is any clock in seconds.
    """

    def __init__(self, initial_s: float, maximum_s: float, random: Callable[[], float]) -> None:
        self._initial_s = initial_s
        self._maximum_s = maximum_s
        self._random = random
        self._next_s = initial_s
        self._running_since: float | None = None

    def adopt(self, initial_s: float, maximum_s: float) -> None:
        """Other settings, and short pauses again."""
        self._initial_s, self._maximum_s = initial_s, maximum_s
        self.hurry()

    def runs(self, now: float) -> None:
        """The adapter runs, until next_s() or longest_s() is called."""
        self._running_since = now

    def coming_s(self, now: float) -> float:
        """What next_s() will give, but for the jitter."""
        return self._initial_s if self._was_stable(now) else self._next_s

    def next_s(self, now: float) -> float:
        if self._was_stable(now):
            self.hurry()
        self._running_since = None
        delay = self._next_s
        self._next_s = min(self._maximum_s, 2 * delay)
        return self._with_jitter(delay)

    def longest_s(self) -> float:
        """For what will hardly mend itself."""
        self._running_since = None
        return self._with_jitter(self._maximum_s)

    def hurry(self) -> None:
        self._next_s = self._initial_s

    def _was_stable(self, now: float) -> bool:
        return self._running_since is not None and now - self._running_since >= STABLE_S

    def _with_jitter(self, delay_s: float) -> float:
        return delay_s * (1 - JITTER * self._random())


class _Cause:
    def __init__(self, told_at: float, left: int) -> None:
        self.told_at = told_at  # for the first time
        self.told_last_at = told_at
        self.left = left  # how often it may be told until REPEAT_LOG_S have passed
        self.untold = 0  # how often it came without being told
        self.again = False  # all was well since: it is news


class Told:
    """Limits repeated log lines: each cause once until all is well again, at most 5 times an hour.

    Texts that differ only in their digits are one cause. `interval_s`: so long at least between two lines of
    the same cause.
    """

    def __init__(self, interval_s: float = 0.0) -> None:
        self.failing = False  # something came since all was well
        self.quiet = False  # and nothing was told since
        self._interval_s = interval_s
        self._causes: dict[str, _Cause] = {}

    def tell(self, cause: str, now: float) -> int | None:
        """How often it came since it was told, this time included; None: not to be told this time."""
        self.failing = True
        cause = re.sub(r"\d+", "#", cause)  # counts differ from time to time
        known = self._causes.get(cause)
        if known is None and len(self._causes) >= CAUSES_MAX:
            # Twice as long, so that one which comes back now and then is told with its count.
            for text in [text for text, c in self._causes.items() if now - c.told_at >= 2 * REPEAT_LOG_S]:
                del self._causes[text]
            if len(self._causes) >= CAUSES_MAX:
                cause = ""
                known = self._causes.get(cause)
        if known is not None and now - known.told_at < REPEAT_LOG_S:
            if not (known.again and known.left) or now - known.told_last_at < self._interval_s:
                known.untold += 1
                return None
            known.left -= 1
            known.again = False
            known.told_last_at = now
        else:
            self._causes[cause] = _Cause(now, TOLD_AT_MOST - 1)
        self.quiet = False
        times = 1 + (known.untold if known else 0)
        self._causes[cause].untold = 0
        return times

    def well(self) -> None:
        """Nothing fails any more: what comes now is news, unless it came very often."""
        self.failing = False
        self.quiet = True
        for cause in self._causes.values():
            cause.again = True


def repeated(times: int) -> str:
    """For a log line: what Told.tell() returned."""
    return f" ({times} times since this was told last)" if times > 1 else ""
