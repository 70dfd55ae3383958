"""The port of one bridge's adapter: opened in a thread of its own, watched for, kept open, given back."""

from __future__ import annotations

import logging
import os
import queue
import threading
import time
from typing import TYPE_CHECKING

from bridged.bridge.kept_port import KeptPort
from bridged.bridge.lifecycle import Event, Verdict
from bridged.errors import NotPermittedError, PortError
from bridged.ports.sharing import Sharing

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged import _relay
    from bridged.ports import Port
    from bridged.ports.watch import Watch
    from bridged.settings import AdapterConfig

log = logging.getLogger(__name__)

LAST_WORDS_S = 0.1

# A device that was plugged in is tried again and again so long: libusb lists it, and udev lets us open it, a
# moment after the kernel has told of it.
SETTLE_S, SETTLE_RETRY_S = 5.0, 0.1
# A port that may not be opened is tried so long before that is an error: the same moment, of whose end a
# container is not told.
REFUSED_S = 1.0


class PortOpener:
    """Opens a port, which may take seconds, in a thread; `fd` is readable when there is a result()."""

    def __init__(self, port: str, open_port: Callable[[str, int], Port], watch: Watch) -> None:
        self.fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self.busy = False  # until the result is fetched
        self.path = port  # where the device was last
        self._port = port
        self._open_port = open_port
        self._watch = watch
        self._results: queue.SimpleQueue[Port | Exception] = queue.SimpleQueue()

    def start(self, baudrate: int) -> None:
        self.busy = True
        threading.Thread(target=self._open, args=(baudrate,), name="open", daemon=True).start()

    def give(self, port: Port) -> None:
        """Makes a port that is open already the result."""
        self.busy = True
        self._end(port)

    def result(self) -> Port | PortError | None:
        """The port, or why it cannot be opened; None: the thread is not done. Any other error is raised."""
        try:
            os.eventfd_read(self.fd)
        except BlockingIOError:
            return None
        result = self._results.get_nowait()
        self.busy = False
        if isinstance(result, Exception) and not isinstance(result, PortError):
            raise result
        return result

    def close(self) -> None:
        """Idempotent."""
        if not self.busy and self.fd >= 0:
            os.close(self.fd)
            self.fd = -1

    def _open(self, baudrate: int) -> None:
        try:
            self._watch.refuse_stranger()
            path = self._watch.path()
            if path not in {self.path, self._port}:
                log.info("%s is opened for %s, by its serial number", path, self._port)
            self.path = path
            self._end(self._open_port(path, baudrate))
        except Exception as error:  # noqa: BLE001 - a bug is raised again in the thread that can end the bridge
            self._end(error)

    def _end(self, result: Port | Exception) -> None:
        self._results.put(result)
        os.eventfd_write(self.fd, 1)


class AdapterPort:
    """Opens the port, attaches it to the relay, and closes it, or keeps it open for the next try.

    The owner calls on_readable() when a descriptor of filenos() is readable, and on_timer() when `next_at`
    (seconds of time.monotonic()) has come.
    """

    def __init__(
        self,
        config: AdapterConfig,
        relay: _relay.Relay,
        open_port: Callable[[str, int], Port],
        watch: Watch,
    ) -> None:
        self.port: Port | None = None  # while it is attached to the relay
        self._config = config
        self._relay = relay
        self._watch = watch
        self._opener = PortOpener(config.port, open_port, watch)
        self._kept = KeptPort(relay)
        self._sharing = Sharing()
        self._settles_by: float | None = None  # what was plugged in may not be usable before that
        self._refused_at: float | None = None  # since when it may not be opened
        self._open_again_at: float | None = None
        self._baudrate = 0

    def filenos(self) -> tuple[int, ...]:
        watch = (self._watch.fd,) if self._watch.fd >= 0 else ()
        return self._opener.fd, *watch

    @property
    def is_opening(self) -> bool:
        """Whether a thread opens the port, which would be in the way of another bridge."""
        return self._opener.busy

    @property
    def next_at(self) -> float | None:
        """When on_timer() is to be called."""
        times = (self._sharing.next_at, self._open_again_at)
        return min((time for time in times if time is not None), default=None)

    def on_timer(self, now: float) -> None:
        self._sharing.on_timer(now)
        if self._open_again_at is not None and now >= self._open_again_at:
            self._open_again_at = None
            self._opener.start(self._baudrate)

    # --- the device comes ---------------------------------------------------------------------

    def watch_for_device(self) -> None:
        """has_come() may be asked from now on, until the port is opened."""
        self._watch.arm()

    def stop_watching(self) -> None:
        """Nor is it tried again."""
        self._watch.disarm()
        self._open_again_at = None

    def is_there(self) -> bool:
        """Whether there is a device to open; True where nobody can know."""
        return self._watch.is_there()

    def has_come(self) -> bool:
        """Whether the device was plugged in since this was asked last."""
        if not self._watch.has_come():
            return False
        log.info("%s was plugged in", self._config.port)
        self._settles_by = time.monotonic() + SETTLE_S
        return True

    # --- open, and closed ---------------------------------------------------------------------

    def open(self, baudrate: int) -> None:
        """Starts to open it; on_readable() tells how that ends."""
        self._watch.disarm()
        self._baudrate = baudrate
        kept = self._kept.take()
        if kept is None:
            self._opener.start(baudrate)
        else:
            self._opener.give(kept)

    def on_readable(self, *, wanted: bool) -> Verdict | None:
        """OPENED, ABSENT, OPEN_FAILED, or None: it is being opened. `wanted`: not by a bridge that ended."""
        result = self._opener.result()
        if result is None:
            return None
        if isinstance(result, NotPermittedError):
            now = time.monotonic()
            self._refused_at = now if self._refused_at is None else self._refused_at
            if wanted and now < self._refused_at + REFUSED_S:
                self._open_again_at = now + SETTLE_RETRY_S
                return None
        else:
            self._refused_at = None
        if isinstance(result, PortError):
            if wanted:
                self._watch.arm()  # before the look, or the device might come between
            there = self._watch.is_there()
            settles = self._settles_by is not None and time.monotonic() < self._settles_by
            pause_s = SETTLE_RETRY_S if settles else None
            return Verdict(Event.OPEN_FAILED if there else Event.ABSENT, str(result), pause_s)
        self._settles_by = None
        try:
            self._relay.attach_port(result.fd)
        except OSError as error:  # no descriptor is left for it
            self._kept.put_back(result)
            return Verdict(Event.OPEN_FAILED, f"{self._opener.path}: cannot be used: {error.strerror}")
        self.port = result
        self._watch.opened(result.fd)
        self._sharing.opened(result.description, time.monotonic())
        self._kept.resume()
        return Verdict(Event.OPENED)

    def adapter_runs(self) -> None:
        """The adapter has read and answered everything."""
        self._kept.runs()

    def suspect_others(self, now: float) -> None:
        """There is a sign that another program has the port open: no answer, or noise."""
        self._sharing.suspect(now)

    def last_words(self, words: bytes) -> None:
        """Says this without awaiting an answer; nothing else is sent any more."""
        if self.port is not None:
            self._relay.last_words(words)
            time.sleep(LAST_WORDS_S)  # close() throws away what is not out yet
        self._relay.detach_port()

    def release(self) -> None:
        """Closes it, or keeps it open for the next try if the device may stand in the middle of a frame."""
        self._relay.detach_port()
        self._sharing.closed()
        if self.port is not None:
            self._kept.release(self.port)
            self.port = None

    def abort(self) -> None:
        """Closes it, whatever the device has read."""
        if self.port is not None:
            self.port.close()
            self.port = None

    def take_over(self, old: AdapterPort) -> None:
        """What a bridge that ended has kept of the port, if this one has the same adapter."""
        if (old._config.type, old._config.port) == (self._config.type, self._config.port):
            self._kept.take_over(old._kept)

    def close(self) -> None:
        """Gives back everything. Idempotent."""
        self._kept.close()
        self._watch.close()
        self._opener.close()
