"""The process around a bridge: one loop over its descriptors, its timers, signals and the status socket."""

from __future__ import annotations

import contextlib
import logging
import os
import selectors
import signal
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType

    from bridged.bridge import Bridge
    from bridged.status import StatusServer

log = logging.getLogger(__name__)

Handler = Callable[[], None]
# SIGHUP comes when the terminal of a bridge in the foreground goes.
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)


@contextlib.contextmanager
def _stop_signals() -> Iterator[int]:
    """A descriptor that becomes readable when one of STOP_SIGNALS comes; ends a select() at once."""
    reader, writer = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)

    def nothing(_number: int, _frame: FrameType | None) -> None:
        """The number comes through the pipe."""

    before = {number: signal.signal(number, nothing) for number in STOP_SIGNALS}
    descriptor = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    try:
        yield reader
    finally:
        signal.set_wakeup_fd(descriptor)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(reader)
        os.close(writer)


def serve(bridge: Bridge, status: StatusServer | None) -> None:
    """Runs the bridge until a signal has stopped it and its adapter is closed."""
    with _stop_signals() as signals, selectors.DefaultSelector() as selector:

        def on_signal() -> None:
            number = os.read(signals, 64)[0]
            log.info("%s: stopping", signal.Signals(number).name)
            bridge.stop()

        selector.register(signals, selectors.EVENT_READ, on_signal)
        for fd in bridge.filenos():
            selector.register(fd, selectors.EVENT_READ, bridge.on_readable)
        if status is not None:
            selector.register(status, selectors.EVENT_READ, status.on_readable)
        try:
            bridge.start()
            while not bridge.finished:
                _turn(bridge, selector)
        except BaseException:
            bridge.abort()
            raise
        finally:
            bridge.close()


def _turn(bridge: Bridge, selector: selectors.BaseSelector) -> None:
    timer = bridge.next_timer()
    timeout = None if timer is None else max(0.0, timer - time.monotonic())
    # One handler may serve several descriptors; it runs once.
    handlers: dict[Handler, None] = {key.data: None for key, _ in selector.select(timeout)}
    for handler in handlers:
        handler()
    if not bridge.finished:
        bridge.on_timer(time.monotonic())
