"""Tells which other programs have the adapter's port open: each of them gets a part of the answers.

A lock keeps out only those who ask for it: `cat`, a terminal program or a second bridge elsewhere may not.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Final

from bridged.ports import sysfs
from bridged.ports.names import PortName

SETTLED_S: Final = 1.0  # after the start, which a look through /proc would delay
PAUSE_S: Final = 10.0  # between two looks: with many processes one takes some milliseconds

_log = logging.getLogger(__name__)


class Sharing:
    """Looks once after the adapter has begun to run, and when there is a sign: no answer, or noise.

    The owner calls on_timer() when `next_at` (seconds of time.monotonic()) has come.
    """

    def __init__(self) -> None:
        self.next_at: float | None = None
        self._port = ""
        self._looked_at = -math.inf
        self._told: list[str] = []

    def opened(self, port: str, now: float) -> None:
        """The port is open: a look follows. `port`: its path; a URL has no other users here."""
        self._port = PortName(port).path
        if self._port:
            self.next_at = max(now + SETTLED_S, self._looked_at + PAUSE_S)

    def closed(self) -> None:
        self._port = ""
        self.next_at = None

    def suspect(self, now: float) -> None:
        """There is a sign of another user."""
        if self._port and now - self._looked_at >= PAUSE_S:
            self._look(now)

    def on_timer(self, now: float) -> None:
        if self.next_at is not None and now >= self.next_at:
            self._look(now)

    def _look(self, now: float) -> None:
        self.next_at = None
        self._looked_at = now
        users = sysfs.users(Path(self._port), others=True)
        if users and users != self._told:
            _log.warning(
                "%s is also open in %s: each gets a part of what the adapter sends; stop that",
                self._port,
                ", ".join(users),
            )
        self._told = users
