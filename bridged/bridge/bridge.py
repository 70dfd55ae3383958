"""One bridge: performs the lifecycle's actions on one adapter, one port and one bus.

Everything here runs in the thread that calls it (service.py's loop); the relay runs in its own, and so
does the opening of a port, which may take seconds.
"""

from __future__ import annotations

import errno
import logging
import os
import queue
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from bridged import _relay
from bridged.adapters import make_adapter
from bridged.adapters.base import Reply
from bridged.bridge.backoff import Backoff, chance
from bridged.bridge.exchanges import REPLIES, Exchanges
from bridged.bridge.health import Finding
from bridged.bridge.interface import Interface
from bridged.bridge.kept_port import KeptPort
from bridged.bridge.lifecycle import Action, Event, State, Verdict, transition
from bridged.bridge.log_limiter import LogLimiter, repeated
from bridged.bridge.polling import NOISE, NOISE_CAUSES, HealthPolling
from bridged.bridge.recovery import Recovery, stuck_s
from bridged.can import BusState
from bridged.errors import PortError
from bridged.interfaces import open_bus as open_any_interface
from bridged.interfaces.base import LOST_BEFORE_READ
from bridged.ports import open_port as open_any_port
from bridged.ports.sharing import Sharing
from bridged.ports.watch import Watch

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged.adapters.base import Memory
    from bridged.bridge.exchanges import Found
    from bridged.interfaces.base import Bus
    from bridged.ports import Port
    from bridged.settings import Config

log = logging.getLogger(__name__)

UNANSWERED_LOG_S = 10.0
LAST_WORDS_S = 0.1
STOP_S = 1.2  # for an adapter that does not answer; systemd and users wait for the end

# A device that was plugged in is tried again and again so long: libusb lists it, and udev lets us open it, a
# moment after the kernel has told of it.
SETTLE_S, SETTLE_RETRY_S = 5.0, 0.1

HAND_OVER_S = 1.0  # for frames that wait when another bridge is to take this one's place
HAND_OVER_LOOK_S = 0.005

# States before the adapter runs for the first time.
COMING_UP = (State.IDLE, State.OPENING, State.INITIALISING)
# States that end at once when the device is plugged in.
AWAITING_DEVICE = (State.WAITING, State.BACKOFF, State.FAULT)
# States entered because the adapter failed.
FAILING = (State.CLOSING, State.REJECTING)
# States that keep showing the reason of the failure before.
KEEPING_REASON = (*AWAITING_DEVICE, State.BUS_OFF)


def _reason(error: int) -> str:
    if error == errno.ETIME:
        return "it took no bytes for too long, and what waited must not be sent late"
    return os.strerror(error) if error else "end of file or hang-up"


def _sum(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """Counters that go on: of a bridge and those before it, some by reason."""
    total = dict(now)
    for name, n in before.items():
        total[name] = _sum(n, now.get(name, {})) if isinstance(n, dict) else n + now.get(name, 0)
    return total


class Bridge:
    """Relays between the adapter and the bus of one configuration.

    The owner calls on_readable() when a descriptor of filenos() is readable and on_timer() when
    next_timer() has come (seconds of time.monotonic()), until `finished`.

    `open_port` gets the port and the baud rate, and is called in a thread of its own; `open_interface` gets
    the settings of bridged.interfaces.open_bus(). `watch` tells when the port's device is plugged in.
    """

    def __init__(
        self,
        config: Config,
        memory: Memory,
        *,
        open_port: Callable[[str, int], Port] = open_any_port,
        open_interface: Callable[..., Bus] = open_any_interface,
        watch: Watch | None = None,
    ) -> None:
        self.config = config
        self.state = State.IDLE
        self.reason = ""  # why the state is not running
        self._pending: deque[Verdict] = deque()  # not acted upon yet, but for the first: that is under way
        self._pause_s: float | None = None  # the next one, if the back-off does not decide
        self._restarts = False  # it left its bus because of bus-off and has not run since
        self.circle = ""  # what neighbours.py has found
        self._told = LogLimiter()
        self.finished = False
        # Whether the adapter's channel may be open, as far as its answers tell; None: it was never asked.
        self.channel_open: bool | None = None
        self.adapter = make_adapter(config, memory)
        self._started = time.monotonic()
        self._port: Port | None = None
        self._timer: float | None = None
        reconnect = config.reconnect
        self._backoff = Backoff(reconnect.initial_s, reconnect.maximum_s, chance)
        self._open_port = open_port
        self._watch = watch or Watch(config.adapter.port, config.adapter.usb_serial_number)
        self._sharing = Sharing()
        self._path = config.adapter.port  # where it was last
        self._opened: queue.SimpleQueue[Port | Exception] = queue.SimpleQueue()
        self._opened_fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._opening = False  # a thread opens the port
        self._settles_by: float | None = None  # what was plugged in may not be usable before that
        self._starts = 0  # how often it began to run
        self._identity: object = None  # that was told
        self._recovery = Recovery(config, self.adapter)
        self._unanswered_told = LogLimiter(UNANSWERED_LOG_S)
        self._counted_before: dict[str, Any] = {}  # by the bridges of this process before this one
        self._holds_bus = False  # its frames wait until the adapter runs, or fails to
        self._stop_by: float | None = None  # told to stop once what was read is sent, or then
        self._look_again_at: float | None = None  # whether it is
        self._turns: object = None  # of the relay, when they were looked at last
        sync = self.adapter.sync
        self._relay = _relay.Relay(
            self.adapter.codec,
            queue=config.transmit.queue,
            window=config.transmit.window,
            deadline=config.transmit.deadline_s,
            stuck=stuck_s(config),
            answer_timeout=self.adapter.answer_timeout_s,
            sync=sync.request,
            sync_prefix=sync.prefix,
        )
        self._kept = KeptPort(self._relay)
        self._interface = Interface(config, self._relay, open_interface)
        self._exchanges = Exchanges(self._relay)
        self._polling = HealthPolling(
            self.adapter,
            config.health.interval_s,
            ask=self._exchanges.ask,
            stuck_s=stuck_s(config),
            tally=self._relay.tally,
        )
        self._thread = threading.Thread(target=self._relay.run, name="relay")

    # --- for the owner ------------------------------------------------------------------------

    def start(self, predecessor: Bridge | None = None) -> None:
        """Starts the relay; the adapter follows when the bus is open.

        `predecessor`: one that was told its successor by stop() and is settled. Its counters go on, so does
        its bus: frames that wait there are read once the adapter runs, or fails to.
        """
        self._thread.start()
        bus = None
        if predecessor is not None:
            bus = predecessor._hand_over_bus(self.config)
            self._take_over_port(predecessor)
            predecessor.close()
            self._counted_before = predecessor.snapshot()["counters"]
            self._started = predecessor._started
        if bus is None:
            self._interface.open()
        else:
            self._holds_bus = True
            self._relay.hold_interface(True)
            assert predecessor is not None
            self._interface.use(bus, predecessor._interface.reason)
        self._start_with_bus()

    def stop(self, successor: Config | None = None) -> None:
        """Closes the adapter, then everything; `finished` says when.

        `successor`: the configuration of the bridge that goes on. If it has the same bus, frames wait in that
        from now on, and those that were read before are sent first, for HAND_OVER_S at most.
        """
        self._interface.retry_at = None
        hands_over = successor is not None and successor.bus == self.config.bus
        self._holds_bus = False
        self._relay.hold_interface(hands_over)
        if hands_over and self.state is State.RUNNING and self._stop_by is None:
            self._stop_by = time.monotonic() + HAND_OVER_S
        elif not hands_over:
            self._stop_by = None
        self._stop_when_sent()

    def _stop_when_sent(self) -> None:
        """A bridge that hands its bus over stops when it has sent what it has read, or cannot."""
        now = time.monotonic()
        waits = self.state is State.RUNNING and self._relay.counters()["queued"]
        if self._stop_by is not None and waits and now < self._stop_by:
            self._look_again_at = now + HAND_OVER_LOOK_S
            return
        self._stop_by = self._look_again_at = None
        self._dispatch(Verdict(Event.STOP))

    def filenos(self) -> tuple[int, ...]:
        watch = (self._watch.fd,) if self._watch.fd >= 0 else ()
        return self._relay.fileno(), self._opened_fd, *watch

    def on_readable(self) -> None:
        try:
            os.eventfd_read(self._opened_fd)
        except BlockingIOError:
            pass
        else:
            self._on_opened()
        for kind, token, text in self._relay.events():
            self._on_event(kind, token, text)
        if self.state in AWAITING_DEVICE and self._watch.has_come():
            log.info("%s was plugged in", self.config.adapter.port)
            self._settles_by = time.monotonic() + SETTLE_S
            self._dispatch(Verdict(Event.APPEARED))

    def next_timer(self) -> float | None:
        parts = (self._interface, self._polling, self._exchanges, self._sharing)
        timers = (self._timer, self._look_again_at, *(part.next_at for part in parts))
        return min((t for t in timers if t is not None), default=None)

    def on_timer(self, now: float) -> None:
        if self._timer is not None and self._timer <= now:
            self._timer = None
            self._dispatch(Verdict(Event.TIMER))
        if self._look_again_at is not None and self._look_again_at <= now:
            self._stop_when_sent()
        if self._interface.on_timer(now):
            self._dispatch(Verdict(Event.RESTART))
        self._start_with_bus()
        self._polling.on_timer(now)
        self._act_on(self._exchanges.on_timer(now))
        self._sharing.on_timer(now)

    def has_turned(self) -> bool:
        """Whether the relay has turned since the last call, which gave it cause to; waits if a turn hangs."""
        turns, self._turns = self._turns, self._relay.counters()["turns"]
        self._relay.wake()
        return turns != self._turns

    def adopt(self, config: Config) -> bool:
        """Goes on with other settings; False: with these it cannot, a new bridge must take its place."""
        present = self.config
        transmit = replace(
            present.transmit, queue=config.transmit.queue, deadline_s=config.transmit.deadline_s
        )
        channel = replace(present.channel, restart_s=config.channel.restart_s)
        if config != replace(
            present, channel=channel, transmit=transmit, health=config.health, reconnect=config.reconnect
        ):
            return False
        self.config = config
        self._relay.set_queue(transmit.queue, transmit.deadline_s, stuck_s(config))
        self._interface.adopt(config)
        self._recovery.adopt(config)
        self._polling.adopt(config.health.interval_s, stuck_s(config))
        self._backoff.adopt(config.reconnect.initial_s, config.reconnect.maximum_s)
        now = time.monotonic()
        if self.state in AWAITING_DEVICE and self._timer is not None:
            self._timer = min(self._timer, now + self._backoff.next_s(now))
        if channel.restart_s is not None:
            self._dispatch(Verdict(Event.RESTART))
        if self._polling.health.state is BusState.BUS_OFF:
            self._act_on(Finding(bus_off="bus-off"))
        return True

    def rates(self) -> dict[str, float]:
        """Frames a second each way."""
        return self._polling.rates()

    def frames_read(self) -> int:
        """From the bus, by this bridge alone."""
        read: Any = self._relay.counters()["bus_read"]
        return int(read)

    def glimpse(self) -> tuple[bytes, bytes]:
        """A frame that came from the bus lately and one that went to it."""
        return self._relay.glimpse()

    def condition(self) -> tuple[State, str, bool]:
        """The state, the reason why it is not running, whether the bus is open."""
        reason = "; ".join(filter(None, (self.reason, self._interface.reason, self.circle)))
        return self.state, reason, self._interface.bus is not None

    def snapshot(self) -> dict[str, Any]:
        """State and counters; see status.py for the meaning of each."""
        lost = self._interface.lost_frames()  # before the relay's, so that each of them is in those
        counters: dict[str, Any] = self._relay.counters()
        for reason, n in lost.items():
            if reason in LOST_BEFORE_READ:
                counters["tx_dropped"][reason] = n
            else:  # the relay took it for delivered
                counters["rx_dropped"][reason] = n
                counters["rx_frames"] -= n
        queued = counters.pop("queued")
        identity = self.adapter.identity
        health = self._polling.health
        counted = {
            "rx_frames": counters.pop("rx_frames"),
            "tx_frames": counters.pop("tx_frames"),
            "tx_queued": counters.pop("tx_queued"),
            "tx_unconfirmed": counters.pop("tx_unconfirmed"),
            "rx_errors": counters.pop("skipped_messages"),
            "tx_retries": counters.pop("tx_retries"),
            "reconnects": max(0, self._starts - 1),
            "bus_off_restarts": health.restarts,
            **health.happened,
            **self._interface.error_frames(),
            "tx_discarded": self.adapter.discarded,
            **counters,
        }
        return {
            "name": self.config.name,
            "state": self.state.value,
            "reason": self.condition()[1],
            "channel_open": self.channel_open,
            "bus_state": health.state.text if health.state is not None else None,
            "tec": health.tec,
            "rec": health.rec,
            "rates": self._polling.rates(),
            "answer_time_ms": self._polling.answer_times_ms(),
            "adapter": {
                "type": self.config.adapter.type,
                "port": self.config.adapter.port,
                "version": identity.version,
                "serial_number": identity.serial_number,
            },
            "bus": {
                "interface": self.config.bus.interface,
                "channel": self.config.bus.channel,
                "open": self._interface.bus is not None,
                "up": self._interface.is_up,
            },
            "counters": _sum(self._counted_before, counted),
            "queued": queued,
            "uptime_s": round(time.monotonic() - self._started, 3),
        }

    def _start_with_bus(self) -> None:
        if self.state is State.IDLE and self._interface.bus is not None:
            self._dispatch(Verdict(Event.START))

    # --- lifecycle ----------------------------------------------------------------------------

    def _act_on(self, found: Found) -> None:
        """Acts on news of any part, as far as they concern the state that the bridge is in."""
        if isinstance(found, Finding):
            for frame in found.error_frames:
                self._interface.put_error_frame(frame)
            if found.failure:
                self._dispatch(Verdict(Event.SILENT, found.failure))
            elif found.bus_off and self.state is State.RUNNING:
                self._act_on(self._recovery.off(found.bus_off))
        elif found is not None:
            if found.off_bus:
                self._act_on(self._polling.taken_off())
            self._dispatch(found)

    def _dispatch(self, verdict: Verdict) -> None:
        """Acts on it, and on what that leads to, one after the other.

        An event that an action leads to waits until all actions before it are done: nothing re-enters.
        """
        self._pending.append(verdict)
        if len(self._pending) > 1:
            return
        while self._pending:
            self._transit(self._pending[0])
            self._pending.popleft()

    def _transit(self, verdict: Verdict) -> None:
        before = self.state
        self.state, actions = transition(before, verdict.event)
        if verdict.event is Event.CLOSED:
            self.channel_open = self._exchanges.last_reply is Reply.NONE
        if before in {State.RUNNING, State.OPENING} and self.state is not before:
            self._pause_s = verdict.pause_s
        if before is State.RUNNING and self.state is not before:
            self._restarts = self._restarts or verdict.off_bus
        if self.state is not before:
            self._log_transition(verdict.reason)
        for action in actions:
            self._perform(action)
        if self._holds_bus and self.state not in COMING_UP:
            self._holds_bus = False
            self._relay.hold_interface(False)

    def _log_transition(self, reason: str) -> None:
        """One line; retries, and what is repeated too often, for those who look for a fault only."""
        if self.state in FAILING:
            self._sharing.suspect(time.monotonic())
        if self._polling.heard_noise() and reason and self.state in FAILING:
            reason += f"; there is {NOISE} ({NOISE_CAUSES})"
        if self.state is State.BUS_OFF:
            reason = f"the bridge has taken the adapter off its CAN bus: {self.reason}"
        self.reason = reason or (self.reason if self.state in KEEPING_REASON else "")
        now = time.monotonic()
        times = self._told.tell(reason, now) if reason else None
        if times is not None:
            again = ""
            if self.state in {State.CLOSING, State.BACKOFF} and self._pause_s is None:
                again = f"; trying again in {self._backoff.coming_s(now):.2g} s"
            log.warning("state=%s: %s%s%s", self.state.value, reason, again, repeated(times))
            return
        quiet = self._told.quiet if self.state is State.RUNNING else self._told.failing
        always = self.state in {State.STOPPING, State.STOPPED, State.BUS_OFF}
        level = logging.DEBUG if quiet and not always else logging.INFO
        log.log(level, "state=%s%s%s", self.state.value, ": " if reason else "", reason)
        if self.state is State.RUNNING:
            self._told.well()

    def _perform(self, action: Action) -> None:
        match action:
            case Action.LOOK:
                self._look()
            case Action.OPEN:
                self._timer = None
                self._watch.disarm()
                self._opening = True
                port = self._kept.take()
                if port is None:
                    threading.Thread(target=self._open, name="open", daemon=True).start()
                else:
                    self._opened.put(port)
                    os.eventfd_write(self._opened_fd, 1)
            case Action.INITIALISE:
                assert self._port is not None
                self.channel_open = True
                steps = self.adapter.init_steps(self._port.serial_number, self._port.product)
                self._act_on(self._exchanges.run(steps, Event.READY))
            case Action.RUN:
                self._run()
            case Action.CLOSE:
                self._close_channel()
            case Action.LIMIT:
                self._timer = time.monotonic() + STOP_S
            case Action.LAST_WORDS:
                log.warning("the adapter did not answer in time: its channel may still be open")
                self._last_words()
            case Action.RELEASE:
                self._release()
            case Action.WAIT:
                pause_s, self._pause_s = self._pause_s, None
                self._wait(self._backoff.next_s(time.monotonic()) if pause_s is None else pause_s)
            case Action.WAIT_LONG:
                self._wait(self._backoff.longest_s())
            case Action.HURRY:
                self._backoff.hurry()
            case Action.FINISH:
                self._finish()

    def _wait(self, seconds: float) -> None:
        self._watch.arm()
        self._timer = time.monotonic() + seconds

    def _look(self) -> None:
        """Looks again now and then: what is no device of the kernel's (a pty) comes without an event."""
        self._wait(self._backoff.next_s(time.monotonic()))
        if self._watch.is_there():
            self._dispatch(Verdict(Event.APPEARED))

    def _open(self) -> None:
        result: Port | Exception
        try:
            self._watch.refuse_stranger()
            path = self._watch.path()
            if path not in {self._path, self.config.adapter.port}:
                log.info("%s has the serial number that is wanted, not %s", path, self.config.adapter.port)
            self._path = path
            result = self._open_port(path, self.adapter.baudrate)
        except Exception as error:  # noqa: BLE001 - a bug is raised again in the thread that can end the bridge
            result = error
        self._opened.put(result)
        os.eventfd_write(self._opened_fd, 1)

    def _on_opened(self) -> None:
        result = self._opened.get_nowait()
        self._opening = False
        if isinstance(result, PortError):
            if not self.finished:
                self._watch.arm()  # before the look, or it might come between
            there = self._watch.is_there()
            settles = self._settles_by is not None and time.monotonic() < self._settles_by
            pause_s = SETTLE_RETRY_S if settles else None
            self._dispatch(Verdict(Event.OPEN_FAILED if there else Event.ABSENT, str(result), pause_s))
            return
        if isinstance(result, Exception):
            raise result
        self._settles_by = None
        try:
            self._relay.attach_port(result.fd)
        except OSError as error:  # no descriptor is left for it
            self._kept.put_back(result)
            reason = f"{self._path}: cannot be used: {error.strerror}"
            self._dispatch(Verdict(Event.OPEN_FAILED, reason))
            return
        self._port = result
        self._watch.opened(result.fd)
        self._sharing.opened(result.description, time.monotonic())
        self._kept.resume()
        self._dispatch(Verdict(Event.OPENED))

    def _run(self) -> None:
        self._backoff.runs(time.monotonic())
        self._kept.runs()
        if self.adapter.polling is not None:
            polling = self.adapter.polling
            self._relay.set_polling(polling.request, polling.prefix, polling.interval_s)
        sending = self.adapter.sending
        self._relay.set_sending(sending.confirms.value, sending.remote.value, window=sending.window or 0)
        if self.adapter.flow is not None:
            flow = self.adapter.flow
            self._relay.set_level_window(
                flow.request, flow.prefix, capacity=flow.capacity, critical=flow.critical, ready=flow.ready
            )
        listen_only = self.config.channel.listen_only
        gate = _relay.GATE_LISTEN_ONLY if listen_only else _relay.GATE_OPEN
        self._relay.set_gates(receiving=True, transmit=gate)
        self._act_on(self._polling.start(time.monotonic(), restarted=self._restarts))
        self._restarts = False
        self._starts += 1
        identity = self.adapter.identity
        if identity != self._identity:
            self._identity = identity
            log.info("adapter version=%s serial_number=%s", identity.version, identity.serial_number)

    def _close_channel(self) -> None:
        bus_state = self._polling.health.state
        self._polling.stop()
        stopping = self.state is State.STOPPING
        # What one that is error-passive has taken may be there for long. (Some firmware does not tell.)
        drain = stopping and (bus_state is None or bus_state < BusState.ERROR_PASSIVE)
        gate = _relay.GATE_STOPPED if stopping else _relay.GATE_AWAY
        self._relay.set_gates(receiving=not self._exchanges.running, transmit=gate)
        self._act_on(self._exchanges.run(self.adapter.close_steps(drain), Event.CLOSED))

    def _release(self) -> None:
        self._recovery.closed()
        self._polling.stop()
        self._exchanges.forget()
        self._relay.detach_port()
        for kind, token, text in self._relay.events():  # of the port that is no more, or of the bus
            if kind in {_relay.EVENT_INTERFACE_LOST, _relay.EVENT_INTERFACE_DOWN}:
                self._on_event(kind, token, text)
        self._sharing.closed()
        if self._port is not None:
            self._kept.release(self._port)
            self._port = None

    def _finish(self) -> None:
        self._timer = None
        self._watch.disarm()
        self._relay.set_gates(receiving=False, transmit=_relay.GATE_STOPPED)
        self._relay.stop()
        self._thread.join()
        self.finished = True

    def abort(self) -> None:
        """For an exception that nobody expected: ends the relay, closes the channel as well as may be."""
        self._relay.stop()
        if self._thread.is_alive():
            self._thread.join()
        self._last_words()
        if self._port is not None:
            self._port.close()
            self._port = None
        self.finished = True

    def _last_words(self) -> None:
        """Closes the channel without awaiting answers."""
        if self._port is not None:
            self._relay.last_words(self.adapter.last_words)
            time.sleep(LAST_WORDS_S)  # close() throws away what is not out yet
        self._relay.detach_port()

    @property
    def settled(self) -> bool:
        """`finished`, and no port is being opened any more that would be in a successor's way."""
        return self.finished and not self._opening

    def _hand_over_bus(self, successor: Config) -> Bus | None:
        """The open bus; None: it was lost, or the successor wants another."""
        if successor.bus != self.config.bus:
            return None
        if any(kind == _relay.EVENT_INTERFACE_LOST for kind, _, _ in self._relay.events()):
            return None
        return self._interface.hand_over()

    def _take_over_port(self, old: Bridge) -> None:
        """What a bridge that ended has kept of the port, if this one has the same adapter."""
        before, adapter = old.config.adapter, self.config.adapter
        if (before.type, before.port) == (adapter.type, adapter.port):
            self._kept.adopt(old._kept)

    def close(self) -> None:
        """After `finished`, or instead of start(): gives back what it holds."""
        self._kept.close()
        self._interface.close()
        self._watch.close()
        if not self._opening and self._opened_fd >= 0:
            os.close(self._opened_fd)
            self._opened_fd = -1

    # --- events of the relay ------------------------------------------------------------------

    def _on_event(self, kind: int, token: int, text: bytes) -> None:
        if kind in REPLIES:
            self._act_on(self._exchanges.answer(kind, token, text))
        elif kind == _relay.EVENT_PORT_LOST:
            failure = self._port.failure if self._port else None
            reason = f"port {self.config.adapter.port} lost: {failure or _reason(token)}"
            self._dispatch(Verdict(Event.PORT_LOST, reason))
        elif kind == _relay.EVENT_SILENT:
            self._dispatch(Verdict(Event.SILENT, "the adapter stopped answering"))
        elif kind == _relay.EVENT_UNANSWERED:
            self._on_unanswered(token)
        elif kind == _relay.EVENT_STUCK:
            if self.state is State.RUNNING:
                self._act_on(self._recovery.stuck(token, self._polling))
        elif kind == _relay.EVENT_FRAME_REFUSED:
            self._polling.frame_refused()
        elif kind == _relay.EVENT_STAMPED:
            self.adapter.saw_time_stamps()
        elif kind == _relay.EVENT_INTERFACE_DOWN:
            self._interface.on_down()
        elif kind == _relay.EVENT_INTERFACE_LOST:
            self._interface.on_lost(token)
        elif kind == _relay.EVENT_NOISE:
            self.adapter.saw_noise(text)
            self._sharing.suspect(time.monotonic())
        else:
            self._act_on(self._polling.heard(text))

    def _on_unanswered(self, resyncs: int) -> None:
        now = time.monotonic()
        self._sharing.suspect(now)
        times = self._unanswered_told.tell("unanswered", now)
        self._unanswered_told.well()
        if times is not None:
            log.warning("no answer from the adapter: resynchronising (resyncs=%d)", resyncs)
