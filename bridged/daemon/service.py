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

from bridged.bridge.lifecycle import State
from bridged.daemon.notify import Notifier
from bridged.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path
    from types import FrameType

    from bridged.bridge.bridge import Bridge
    from bridged.daemon.config_map import MountedConfig
    from bridged.daemon.neighbours import Neighbours
    from bridged.daemon.state_hook import StateHook
    from bridged.daemon.status import StatusServer
    from bridged.settings import Config

log = logging.getLogger(__name__)

Handler = Callable[[], None]
# Builds the bridge that replaces the one of this configuration. None: nothing has changed. ConfigError.
Successor = Callable[["Config"], "Bridge | None"]

READY_LIMIT_S = 5.0  # a boot does not wait longer for the CAN interface
PIPE_SIZE = 1 << 16  # all that fits into the pipe of the signals
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)


def hangup_means_reload() -> bool:
    """What SIGHUP is for: the end of the terminal that the bridge runs in, or a service's sign to reload.

    INVOCATION_ID tells nothing: whatever is started in a terminal of some desktops inherits it.
    """
    if "NOTIFY_SOCKET" in os.environ:
        return True
    try:
        os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC))
    except OSError:  # ENXIO: no controlling terminal
        return True
    return False


@contextlib.contextmanager
def _signals() -> Iterator[tuple[int, set[int]]]:
    """A descriptor that becomes readable when one of SIGNALS comes, which ends a select() at once; and a set
    that it is put in, since the number does not get into a pipe that many signals have filled."""
    reader, writer = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    came: set[int] = set()

    def note(number: int, _frame: FrameType | None) -> None:
        came.add(number)

    before = {number: signal.signal(number, note) for number in SIGNALS}
    descriptor = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    try:
        yield reader, came
    finally:
        signal.set_wakeup_fd(descriptor)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(reader)
        os.close(writer)


def serve(bridge: Bridge, status: StatusServer | None) -> None:
    """Runs the bridge until a signal has stopped it and its adapter is closed."""
    Service(bridge).run(status)


class Service:
    """Runs `bridge`, and after each SIGHUP the one that `successor` makes, or the same if that can take over
    the new configuration; without `successor` SIGHUP is a stop.

    The adapter of the old one is closed before the new one opens its own. The process, its counters, the
    status socket and, unless its section has changed, the open interface stay: frames sent meanwhile wait
    there until the new adapter runs, or fails to. What `mounted` finds changed is reloaded like that, too.
    """

    def __init__(
        self,
        bridge: Bridge,
        notifier: Notifier | None = None,
        successor: Successor | None = None,
        mounted: MountedConfig | None = None,
    ) -> None:
        self.bridge = bridge
        self._notifier = notifier or Notifier()
        self._make_successor = successor
        self._mounted = mounted if successor else None
        self._successor: Bridge | None = None  # waits for the end of `bridge`
        self._ready_at: float | None = None  # what the service waits for is told by then; None: it was
        self._status = ""
        self._told: tuple[object, ...] = ()
        self._refusal = ""  # why the last reload was refused
        self._own_socket: Path | None = None
        self._neighbours: Neighbours | None = None
        self._hook: StateHook | None = None

    def run(self, status: StatusServer | None = None) -> None:
        """Runs until a signal has stopped it and the adapter is closed."""
        with _signals() as signals, selectors.DefaultSelector() as selector:
            selector.register(signals[0], selectors.EVENT_READ, lambda: self._on_signals(*signals))
            if status is not None:
                self._own_socket = status.path
                selector.register(status, selectors.EVENT_READ, status.on_readable)
            self._watch(selector)
            self._ready_at = time.monotonic() + READY_LIMIT_S
            try:
                self.bridge.start()
                self._tell()
                while not self.bridge.finished or self._successor is not None:
                    self._turn(selector)
                    if self._successor is not None and self.bridge.settled:
                        self._succeed(selector, self._successor)
                    self._tell()
            except BaseException:
                self.bridge.abort()
                raise
            finally:
                self.bridge.close()
                if self._hook is not None:
                    self._hook.close()

    def _watch(self, selector: selectors.BaseSelector) -> None:
        for fd in self.bridge.filenos():
            selector.register(fd, selectors.EVENT_READ, self.bridge.on_readable)

    def _turn(self, selector: selectors.BaseSelector) -> None:
        timers = [self._notifier.feed_at, self._ready_at]
        timers += [part.next_at for part in (self._mounted, self._hook) if part]
        if not self.bridge.finished:
            timers.append(self.bridge.next_timer())
        timer = min((at for at in timers if at is not None), default=None)
        timeout = None if timer is None else max(0.0, timer - time.monotonic())
        # One handler may serve several descriptors; it runs once.
        handlers: dict[Handler, None] = {key.data: None for key, _ in selector.select(timeout)}
        for handler in handlers:
            handler()
        if not self.bridge.finished:
            self.bridge.on_timer(time.monotonic())
        self._feed(time.monotonic())
        self._look_around(time.monotonic())
        self._look_at_configuration(time.monotonic())

    def _look_at_configuration(self, now: float) -> None:
        if self._mounted and self._make_successor and self._mounted.look(now):
            log.info("the mounted configuration is another one: reloading")
            self._reload(self._make_successor)

    def _look_around(self, now: float) -> None:
        if self._own_socket is None or self.bridge.finished:
            return
        if self._neighbours is None:
            if self.bridge.state is not State.RUNNING:
                return
            from bridged.daemon.neighbours import Neighbours  # noqa: PLC0415 - never at the cost of the start

            self._neighbours = Neighbours(self._own_socket)
        self._neighbours.look(self.bridge, now)

    # --- signals ------------------------------------------------------------------------------

    def _on_signals(self, fd: int, came: set[int]) -> None:
        """All that came, each once however often it came; a stop leaves nothing to reload."""
        numbers = set(os.read(fd, PIPE_SIZE))
        while came:
            numbers.add(came.pop())
        stops = numbers if self._make_successor is None else numbers - {signal.SIGHUP}
        if stops:
            self._stop(signal.Signals(min(stops)).name)
        elif self._make_successor is not None:
            self._reload(self._make_successor)

    def _stop(self, name: str) -> None:
        log.info("%s: stopping", name)
        self._notifier.stopping()
        self._discard_successor()
        self.bridge.stop()

    def _reload(self, make_successor: Successor) -> None:
        if self.bridge.state in {State.STOPPING, State.STOPPED} and self._successor is None:
            return  # told to stop before
        self._notifier.reloading()
        try:
            successor = make_successor((self._successor or self.bridge).config)
        except ConfigError as error:
            for problem in error.problems:
                log.error("reload refused: %s", problem)
            self._refusal = error.problems[0]
            self._notifier.ready()
            return
        self._refusal = ""
        if successor is None:
            log.info("reload: nothing has changed")
            self._notifier.ready()
            return
        if self._successor is None and self.bridge.reconfigure(successor.config):
            successor.close()
            log.info("reload: the configuration has changed, the adapter stays open")
            self._notifier.ready()
            return
        log.info("reload: the configuration has changed, reopening the adapter")
        self._discard_successor()
        self._successor = successor
        self.bridge.stop(successor.config)

    def _discard_successor(self) -> None:
        if self._successor is not None:
            self._successor.close()
            self._successor = None

    def _succeed(self, selector: selectors.BaseSelector, successor: Bridge) -> None:
        old = self.bridge
        for fd in old.filenos():
            selector.unregister(fd)
        self.bridge, self._successor = successor, None
        self._watch(selector)
        self.bridge.start(old)
        self._notifier.ready()

    # --- systemd ------------------------------------------------------------------------------

    def _tell(self) -> None:
        state, reason, interface_open = self.bridge.condition()
        self._tell_status(state, reason, interface_open=interface_open)
        self._tell_ready(time.monotonic(), reason, interface_open=interface_open)
        self._tell_command(time.monotonic())

    def _tell_command(self, now: float) -> None:
        command = self.bridge.config.notify
        if self._hook is None:
            if not command:
                return
            from bridged.daemon.state_hook import StateHook  # noqa: PLC0415 - most have none

            self._hook = StateHook()
        self._hook.look(command, self._hook.change_of(self.bridge), now)

    def _tell_status(self, state: State, reason: str, *, interface_open: bool) -> None:
        told = (self.bridge, state, reason, interface_open, self._refusal)
        if told == self._told:
            return
        self._told = told
        self._status = _describe(self.bridge, state, reason, interface_open=interface_open) or self._status
        refusal = f" (reload refused: {self._refusal})" if self._refusal else ""
        self._notifier.status(self._status + refusal)

    def _tell_ready(self, now: float, reason: str, *, interface_open: bool) -> None:
        """Once: the interface is open, or it is not to be had and a boot must not hang for it."""
        if self._ready_at is None or not (interface_open or now >= self._ready_at):
            return
        self._ready_at = None
        if not interface_open:
            log.error("ready without the CAN interface, which is tried again each second: %s", reason)
        self._notifier.ready()
        if self._notifier.feed_interval_s is not None:
            self._notifier.feed_at = now

    def _feed(self, now: float) -> None:
        """Feeds the watchdog if the relay has turned since the last time: each feeding gives it cause to."""
        interval_s = self._notifier.feed_interval_s
        if interval_s is None or self._notifier.feed_at is None or now < self._notifier.feed_at:
            return
        self._notifier.feed_at = now + interval_s
        if self.bridge.finished or self.bridge.has_turned():
            self._notifier.feed()
        else:
            log.error("the relay hangs: systemd's watchdog is not fed any more")


def _describe(bridge: Bridge, state: State, reason: str, *, interface_open: bool) -> str:
    """The line for `systemctl status`; empty between two tries, where the last one goes on."""
    adapter = bridge.config.adapter
    if state in {State.STOPPING, State.STOPPED}:
        return "stopping"
    if not interface_open:
        return reason or "opening the CAN interface"
    if state is State.RUNNING:
        identity = bridge.adapter.identity
        words = [adapter.type.upper(), identity.version or "", identity.serial_number or ""]
        but = f", but {reason}" if reason else ""
        return f"running: {' '.join(filter(None, words))} on {adapter.port}, {bridge.config.bus.channel}{but}"
    if state in {State.FAULT, State.BUS_OFF}:
        return f"{state.value}: {reason}"
    return f"waiting: {reason}" if state in {State.WAITING, State.BACKOFF} and reason else ""
