"""Growth: 1, 4, 16, 64 bridges share a load, each a process with a vcan and a port of its own.

A fleet grows from one size to the next, so that no more bridges are there than are measured. The load is one
program for all of them, which offers a frame each 125 µs, to one bridge after the other.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from subjects import Load, Ours, words_of

if TYPE_CHECKING:
    from guest import Session

SIZES = (1, 4, 16, 64)
RATE = 8000  # frames a second over all of them


class Member(Ours):
    """Its questions are answered by the fleet's load."""

    def _keep(self) -> None:
        pass


class Fleet:
    """Bridges, and one load that answers their questions while they are not measured."""

    def __init__(self, load: Load, directory: Path) -> None:
        self._load = load
        self._directory = directory
        self._keeper: subprocess.Popen[bytes] | None = None
        self._members: list[Member] = []

    def grow(self, size: int) -> None:
        new = [
            Member(f"fleet-{number}", self._directory, self._load, vcan=f"fleet{number}")
            for number in range(len(self._members), size)
        ]
        self._members += new
        for member in new:
            member.prepare()
        self._unkeep()
        self._keep()
        for member in new:
            member.launch()

    def sample(self, *options: object) -> dict[str, Any]:
        """Of all of them together."""
        before = self._dropped()
        self._unkeep()
        result = self._load.run(self._members, "--epoll", *options)
        self._keep()
        result["told"] = self._dropped() - before
        result["unaccounted"] = sum(member.unaccounted() for member in self._members)
        return result

    def _dropped(self) -> int:
        return sum(member.dropped() for member in self._members)

    def _keep(self) -> None:
        self._keeper = self._load.keep(self._members)

    def _unkeep(self) -> None:
        if self._keeper is not None:
            self._keeper.kill()
            self._keeper.wait()

    def stop(self) -> None:
        """At once: to end 64 of them in good order takes this machine a minute."""
        for pid in [pid for member in self._members for pid in member.pids]:
            with contextlib.suppress(ProcessLookupError):  # its end may be why we stop
                os.kill(pid, signal.SIGKILL)
        for member in self._members:
            member.stop()
        self._unkeep()


def measure(session: Session) -> None:
    """Each size under its load, and idle: so what is asked for health is known apart."""
    repetitions, seconds = (1, 0.2) if session.quick else (3, 1.0)
    fleet = Fleet(session.load, session.directory)
    try:
        for size in SIZES[:2] if session.quick else SIZES:
            began = time.monotonic()
            fleet.grow(size)
            print(f"{size} bridges: started in {time.monotonic() - began:.1f} s", flush=True)
            for repetition in range(repetitions):
                for options in (
                    {"direction": "to-bus", "rate": RATE, "seconds": seconds, "warm_up": 0.1, "drain": 5},
                    {"direction": "idle", "rate": 0, "seconds": 4, "warm_up": 0},
                ):
                    sample = fleet.sample(*words_of(options))
                    name = f"can-bridge x {size}"
                    session.add("growth", name, repetition, options, sample | {"size": size})
    finally:
        fleet.stop()
