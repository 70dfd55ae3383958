"""Where log lines go: to systemd's journal with the fields BRIDGE= and STATE=, else to stderr."""

from __future__ import annotations

import logging
import os
import select
import sys
from typing import TYPE_CHECKING, Any

from bridged.text import printable

if TYPE_CHECKING:
    from collections.abc import Callable

# sd-daemon(3): what is in front of a line for the journal to know its priority
_PREFIXES = {logging.DEBUG: "<7>", logging.INFO: "<6>", logging.WARNING: "<4>", logging.ERROR: "<3>"}


class Fields(logging.Filter):
    """Gives each record the journal's fields BRIDGE= and STATE=; `state` may be replaced."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._bridge = name
        self.state: Callable[[], str] = lambda: "idle"

    def filter(self, record: logging.LogRecord) -> bool:
        record.BRIDGE, record.STATE = self._bridge, self.state()
        return True


class StderrHandler(logging.StreamHandler[Any]):
    """Never waits for a reader: a full pipe must not stop the bridge. What it could not say it counts."""

    lost = 0

    def emit(self, record: logging.LogRecord) -> None:
        poll = select.poll()
        try:
            poll.register(self.stream, select.POLLOUT)
            writable = poll.poll(0)
        except (OSError, ValueError):  # closed
            return
        if not writable:
            self.lost += 1
            return
        if self.lost:
            record.msg, record.args = f"{record.getMessage()} ({self.lost} lines before this are lost)", ()
            self.lost = 0
        super().emit(record)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        """Nobody is left to be told."""


class LineFormatter(logging.Formatter):
    """One line for each message: a device's words must not look like a line of ours, or move the cursor."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        record.message = printable(record.message)
        return super().formatMessage(record)


class PrefixFormatter(LineFormatter):
    """Each line, also of a traceback, with its priority: the journal reads stderr line by line."""

    def format(self, record: logging.LogRecord) -> str:
        prefix = _PREFIXES.get(record.levelno, "<2>")
        return "\n".join(prefix + line for line in super().format(record).splitlines())


def start_logging(name: str, *, verbose: bool) -> Fields:
    """Set the root logger up for the bridge `name`."""
    name = printable(name)
    fields = Fields(name)
    handler = _make_handler(name)
    handler.addFilter(fields)
    logging.basicConfig(level=logging.DEBUG if verbose else logging.INFO, handlers=[handler])
    return fields


def _make_handler(name: str) -> logging.Handler:
    name = name.replace("%", "%%")
    handler: logging.Handler = StderrHandler()
    if not _stderr_is_journal():
        handler.setFormatter(LineFormatter(f"%(asctime)s %(levelname)-7s {name}: %(message)s"))
        return handler
    try:
        from systemd.journal import JournalHandler  # noqa: PLC0415 - an extra
    except ImportError:
        handler.setFormatter(PrefixFormatter(f"{name}: %(message)s"))
    else:
        handler = JournalHandler(SYSLOG_IDENTIFIER="can-bridge")
        handler.setFormatter(LineFormatter(f"{name}: %(message)s"))
    return handler


def _stderr_is_journal() -> bool:
    """systemd.exec(5): JOURNAL_STREAM is inherited, so stderr may have been led elsewhere since."""
    try:
        stream = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):  # closed
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{stream.st_dev}:{stream.st_ino}"
