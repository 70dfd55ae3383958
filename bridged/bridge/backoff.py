"""The pauses before an adapter that failed is tried again. No clock: the time is passed in."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

STABLE_S: Final = 60.0  # the adapter ran so long: what failed before is forgotten
JITTER: Final = 0.2  # a pause is shorter by up to this part, so that many bridges do not try in step


def chance() -> float:
    """From 0 to below 1. (The module random is 3 % of the time that the bridge takes to start.)"""
    return int.from_bytes(os.urandom(4)) / 2**32


class Backoff:
    """Seconds until the next try: doubling from `initial_s` to `maximum_s`, each with jitter.

    They are short again after reset(), and after the adapter ran for STABLE_S: running for a moment only
    does not shorten them. `random` gives 0 to 1; `now` is any clock in seconds.
    """

    def __init__(self, initial_s: float, maximum_s: float, random: Callable[[], float]) -> None:
        self._initial_s = initial_s
        self._maximum_s = maximum_s
        self._random = random
        self._next_s = initial_s
        self._running_since: float | None = None

    def reconfigure(self, initial_s: float, maximum_s: float) -> None:
        """Other settings, and short pauses again."""
        self._initial_s, self._maximum_s = initial_s, maximum_s
        self.reset()

    def runs(self, now: float) -> None:
        """The adapter runs, until next_s() or longest_s() is called."""
        self._running_since = now

    def coming_s(self, now: float) -> float:
        """What next_s() will give, but for the jitter."""
        return self._initial_s if self._was_stable(now) else self._next_s

    def next_s(self, now: float) -> float:
        if self._was_stable(now):
            self.reset()
        self._running_since = None
        delay = self._next_s
        self._next_s = min(self._maximum_s, 2 * delay)
        return self._with_jitter(delay)

    def longest_s(self) -> float:
        """For what will hardly mend itself."""
        self._running_since = None
        return self._with_jitter(self._maximum_s)

    def reset(self) -> None:
        self._next_s = self._initial_s

    def _was_stable(self, now: float) -> bool:
        return self._running_since is not None and now - self._running_since >= STABLE_S

    def _with_jitter(self, delay_s: float) -> float:
        return delay_s * (1 - JITTER * self._random())
