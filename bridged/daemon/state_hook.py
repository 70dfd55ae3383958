"""Runs the command of `notify` when the state of a bridge, or that of its CAN bus, is another one.

The command runs in a process group of its own, and nobody waits for it: it is looked at once a second while
it runs, and killed after LIMIT_S. What it leaves running in its group ends with it.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import signal
from typing import TYPE_CHECKING, Final, NamedTuple

from bridged.bridge.lifecycle import State
from bridged.text import printable

if TYPE_CHECKING:
    from bridged.bridge.bridge import Bridge

log = logging.getLogger(__name__)

SETTLE_S: Final = 0.5  # what changes again sooner is not told
PAUSE_S, PAUSE_MAX_S = 1.0, 60.0  # between two starts, doubling while changes go on
REST_S: Final = 120.0  # without a start, after which the pause is short again
LIMIT_S: Final = 30.0
LOOK_INTERVAL_S: Final = 1.0
# On the way from one state to another, or the end, which whoever has caused it knows.
PASSING: Final = {
    State.OPENING,
    State.INITIALISING,
    State.REJECTING,
    State.CLOSING,
    State.LEAVING,
    State.STOPPING,
    State.STOPPED,
}
# Python ignores SIGPIPE, and run() SIGHUP at its end: a command expects neither.
SIGNALS: Final = (signal.SIGPIPE, signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGQUIT)


class Change(NamedTuple):
    """What the command is told."""

    state: str
    bus_state: str  # empty: not known
    reason: str
    name: str
    interface: str

    def is_like(self, other: Change | None) -> bool:
        """Whether it differs in words only."""
        return other is not None and self[:2] == other[:2]

    def environment(self) -> dict[str, str]:
        return {f"CAN_BRIDGE_{name.upper()}": printable(text) for name, text in self._asdict().items()}


class StateHook:
    """The owner calls look() after each turn of its loop, and when `next_at` has come; at the end close().

    Times are seconds of any clock.
    """

    def __init__(self) -> None:
        self._told: Change | None = None
        self._pending: Change | None = None
        self._due_at = math.inf
        self._pause_s = PAUSE_S
        self._started_at = -math.inf
        self._pid: int | None = None  # of the command that runs, and of its group
        self._look_at = math.inf
        self._failure = ""  # that is in the log

    @property
    def next_at(self) -> float | None:
        """When look() is to be called."""
        at = self._due_at if self._pid is None else self._look_at
        return None if at == math.inf else at

    @staticmethod
    def change_of(bridge: Bridge) -> Change | None:
        """The present state; None: it will be another one soon."""
        state, reason, _ = bridge.condition()
        if state in PASSING:
            return None
        bus_state = bridge.bus_state() if state is State.RUNNING else None
        config = bridge.config
        text = "" if bus_state is None else bus_state.text
        return Change(state.value, text, reason, config.name, config.bus.channel)

    def look(self, command: tuple[str, ...], change: Change | None, now: float) -> None:
        """Takes note of the present state (None: a passing one), and starts the command if it is time."""
        if change is not None:
            self._note(change, now)
        if self._pid is not None and now >= self._look_at:
            self._look_at = now + LOOK_INTERVAL_S
            self._reap(command, now)
        if self._pid is None and self._pending is not None and now >= self._due_at:
            self._start(command, self._pending, now)

    def close(self) -> None:
        """Ends what runs. Idempotent."""
        if self._pid is not None:
            _kill_group(self._pid)
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self._pid, os.WNOHANG)  # if it is not gone yet, it is the init process's soon
            self._pid = None

    def _note(self, change: Change, now: float) -> None:
        if change.is_like(self._told):
            self._pending, self._due_at = None, math.inf
        elif change.is_like(self._pending):
            self._pending = change
        else:
            self._pending = change
            self._due_at = max(now + SETTLE_S, self._started_at + self._pause_s)

    def _start(self, command: tuple[str, ...], change: Change, now: float) -> None:
        often = now - self._started_at < REST_S
        self._pause_s = min(2 * self._pause_s, PAUSE_MAX_S) if often else PAUSE_S
        self._told, self._pending, self._due_at = change, None, math.inf
        self._started_at = now
        if not command:  # a reload has removed it
            return
        try:
            self._pid = _spawn(command, change)
        except OSError as error:
            self._tell(command, f"cannot be run: {error.strerror}")
        else:
            self._look_at = now + LOOK_INTERVAL_S

    def _reap(self, command: tuple[str, ...], now: float) -> None:
        assert self._pid is not None
        try:
            # Not taken away yet: until then nobody else's group can have its number.
            ended = os.waitid(os.P_PID, self._pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        except ChildProcessError:
            self._pid = None
            return
        if ended is None:
            if now >= self._started_at + LIMIT_S:
                self._tell(command, f"did not end within {LIMIT_S:g} s and is killed")
                _kill_group(self._pid)
            return
        _kill_group(self._pid)
        os.waitpid(self._pid, 0)
        self._pid = None
        if ended.si_code != os.CLD_EXITED:
            if now < self._started_at + LIMIT_S:
                self._tell(command, f"was ended by signal {ended.si_status}")
        elif ended.si_status:
            self._tell(command, f"ended with status {ended.si_status}")
        else:
            self._failure = ""

    def _tell(self, command: tuple[str, ...], failure: str) -> None:
        """Once, until the command works again or fails in another way."""
        text = f"{command[0]} {failure}"
        if text != self._failure:
            self._failure = text
            log.warning("notify: %s", text)


def _spawn(command: tuple[str, ...], change: Change) -> int:
    """Start it, without a copy of this process as fork() makes: frames go on meanwhile. OSError."""
    return os.posix_spawnp(
        command[0],
        command,
        {**os.environ, **change.environment()},
        file_actions=[(os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0)],
        setpgroup=0,
        setsigmask=(),
        setsigdef=SIGNALS,
    )


def _kill_group(pid: int) -> None:
    with contextlib.suppress(OSError):  # all have ended; or some may not be killed by us (set-user-id)
        os.killpg(pid, signal.SIGKILL)
