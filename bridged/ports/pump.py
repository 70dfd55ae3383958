"""A descriptor for a device that has none: two threads between it and one end of a socketpair."""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged.errors import BridgeError

POLL_INTERVAL_S = 0.25  # how long a thread may sit in a device's own call before it looks whether to stop
JOIN_LIMIT_S = 1.0

_log = logging.getLogger(__name__)


class Pump:
    """Base: a subclass says how to move data inward and outward and how to let the device go.

    The relay polls `fd`. It sees end of file when either direction has failed; `failure` says why.
    """

    error: type[BridgeError]

    def __init__(self, description: str, kind: socket.SocketKind) -> None:
        self.description = description
        self.failure: BridgeError | None = None
        self._stopping = threading.Event()
        self._near, self._far = socket.socketpair(socket.AF_UNIX, kind)
        self._near.setblocking(False)
        self.fd = self._near.fileno()
        self._threads = [
            threading.Thread(
                target=self._run, args=(loop,), name=f"{loop.__name__} {description}", daemon=True
            )
            for loop in (self._inward, self._outward)
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop both threads and let the device go. Idempotent; 3 x JOIN_LIMIT_S if the driver is stuck."""
        if self.fd < 0:
            return
        self.fd = -1
        self._stopping.set()
        self._end()
        self._join(self._threads)
        # Only now: few drivers bear to be closed while another thread is in a call of theirs.
        release = threading.Thread(target=self._let_go, name=f"close {self.description}", daemon=True)
        release.start()
        self._join([release])
        stuck = self._join([release, *self._threads])
        self._near.close()
        if stuck:  # it may still use the far end, whose number must not be given to another file
            _log.warning("stuck pump=%s threads=%s", self.description, ",".join(t.name for t in stuck))
        else:
            self._far.close()

    def _inward(self) -> None:
        """Move data from the device to `_far` until `_stopping`; an exception ends the pump."""
        raise NotImplementedError

    def _outward(self) -> None:
        """Move data from `_far` to the device until end of file; an exception ends the pump."""
        raise NotImplementedError

    def _release(self) -> None:
        """Close the device."""
        raise NotImplementedError

    def _run(self, loop: Callable[[], None]) -> None:
        try:
            loop()
        except Exception as error:  # noqa: BLE001 - drivers raise what they like, and nobody else would see it
            if self.failure is None and not self._stopping.is_set():
                failure = self.error(f"{self.description}: {error or type(error).__name__}")
                failure.__cause__ = error
                self.failure = failure
        finally:
            self._end()

    def _end(self) -> None:
        """The relay and both threads see end of file, after what is already on its way."""
        with contextlib.suppress(OSError):
            self._far.shutdown(socket.SHUT_RDWR)

    def _let_go(self) -> None:
        try:
            self._release()
        except Exception as error:  # noqa: BLE001 - the same drivers; there is nothing left to save
            _log.warning("close-failed pump=%s error=%s", self.description, error)

    @staticmethod
    def _join(threads: list[threading.Thread]) -> list[threading.Thread]:
        """Wait for the threads, JOIN_LIMIT_S in all; the ones that are still there."""
        deadline = time.monotonic() + JOIN_LIMIT_S
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        return [thread for thread in threads if thread.is_alive()]
