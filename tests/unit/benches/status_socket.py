"""Status sockets as the tests of status.py and cli.py need them: of a bridge, and of somebody else."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from bridged.daemon.status import StatusServer


def snapshot(name: str = "can232", **changes: Any) -> dict[str, Any]:
    """The status of a bridge that runs."""
    counters = {
        "rx_frames": 20,
        "tx_frames": 84,
        "tx_queued": 0,
        "tx_unconfirmed": 0,
        "tx_late": 0,
        "rx_errors": 0,
        "rx_overruns": 0,
        "tx_retries": 1,
    }
    dropped = {"tx_dropped": {"queue-full": 0, "stale": 0}, "rx_dropped": {"not-running": 0}}
    return {
        "version": "1.2.3",
        "name": name,
        "state": "running",
        "reason": "",
        "channel_open": True,
        "bus_state": "error-active",
        "tec": 0,
        "rec": 3,
        "rates": {"rx_fps": 10.0, "tx_fps": 42.0},
        "answer_time_ms": {"min": 0.4, "median": 0.6, "max": 2.0},
        "adapter": {
            "type": "can232",
            "port": "/dev/ttyUSB0",
            "version": "V1010",
            "serial_number": "A123",
            "opened": "/dev/ttyUSB0",
            "firmware": "can232",
            "sent_means": "sent means taken",
        },
        "bus": {"interface": "socketcan", "channel": "vcan0", "open": True, "up": True},
        "counters": counters | dropped,
        "queued": 0,
        "uptime_s": 9.3,
    } | changes


@contextlib.contextmanager
def serving(path: Path, found: dict[str, Any]) -> Iterator[None]:
    """A bridge with this status."""
    server = StatusServer(path, lambda: found)
    end, ended = socket.socketpair()

    def serve() -> None:
        while ended not in select.select([server, ended], [], [])[0]:
            server.on_readable()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        end.close()
        thread.join()
        ended.close()
        server.close()


@contextlib.contextmanager
def listening(path: Path, talk: Callable[[socket.socket], None]) -> Iterator[None]:
    """Somebody who listens at `path` and talks to one who connects."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve() -> None:
            with contextlib.suppress(OSError), listener.accept()[0] as connection:
                talk(connection)

        thread = threading.Thread(target=serve)
        thread.start()
        yield
        with contextlib.suppress(OSError):
            listener.shutdown(socket.SHUT_RDWR)
        thread.join()
