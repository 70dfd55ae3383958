"""The probes of container engines and supervisors, answered from the status of a bridge.

started: the CAN interface is up, adapter or not. ready: adapter and interface carry frames. live: the process
turns; an adapter that is away is no reason to restart it, and where it holds the network namespace a restart
takes the interface from every program in it.
"""

from __future__ import annotations

from typing import Any

from bridged.daemon.status import is_running, is_started
from bridged.text import printable


def answer(probe: str, status: dict[str, Any]) -> tuple[bool, str]:
    """Whether the probe holds, and one line that says so, with the reason if it does not."""
    holds = {
        "started": is_started(status),
        "ready": is_started(status) and is_running(status),
        "live": True,  # it has answered
    }[probe]
    name, state, reason = (str(status.get(key, "")) for key in ("name", "state", "reason"))
    because = f" ({reason})" if reason else ""
    return holds, printable(f"{name}: {probe if holds else f'not {probe}'}, {state}{because}")
