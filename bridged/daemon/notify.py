"""What systemd is told of the service: sd_notify(3), and its watchdog."""

from __future__ import annotations

import logging
import os
import time
from typing import TYPE_CHECKING

from bridged.errors import ConfigError
from bridged.text import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

log = logging.getLogger(__name__)

MISSING = (
    "systemd waits for news of this service (NOTIFY_SOCKET is set), and to send them takes systemd-python: "
    "`apt install python3-systemd`, or `pip install 'can-bridge[systemd]'`"
)


class Notifier:
    """Tells systemd what it wants to know; without `send` it tells nobody.

    `feed_interval_s`: how often the watchdog wants feed(), None if there is none. `feed_at`: when the next
    is due, in seconds of time.monotonic(); None: before it is ready.
    """

    def __init__(
        self, send: Callable[[str], object] | None = None, feed_interval_s: float | None = None
    ) -> None:
        self._send = send
        self._status = ""
        self.feed_interval_s = feed_interval_s
        self.feed_at: float | None = None

    def ready(self) -> None:
        """Started, or done with a reload."""
        self._notify("READY=1")

    def reloading(self) -> None:
        self._notify(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        self._notify("STOPPING=1")

    def feed(self) -> None:
        self._notify("WATCHDOG=1")

    def status(self, text: str) -> None:
        """The line that `systemctl status` shows; sent when it changes."""
        if text != self._status:
            self._status = text
            self._notify(f"STATUS={printable(text)}")

    def _notify(self, message: str) -> None:
        if self._send is None:
            return
        try:
            self._send(message)
        except OSError as error:  # a systemd that is just being replaced; it asks again by its watchdog
            log.warning("cannot notify systemd: %s", error)


def systemd_notifier(environment: Mapping[str, str] = os.environ) -> Notifier:
    """As the environment asks for it.

    ConfigError: it does, and systemd-python is missing. To go on would be worse: systemd waits for READY=1,
    then kills the service, over and over, and tells nobody why.
    """
    if not environment.get("NOTIFY_SOCKET"):
        return Notifier()
    try:
        from systemd.daemon import notify  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError([MISSING]) from error
    return Notifier(notify, feed_interval_s(environment))


def feed_interval_s(environment: Mapping[str, str]) -> float | None:
    """Half of the time after which systemd loses patience with this process (sd_watchdog_enabled(3))."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    try:
        limit_us = int(environment.get("WATCHDOG_USEC", ""))
    except ValueError:
        return None
    return limit_us / 2e6 if limit_us > 0 else None
