"""One bridge: performs the lifecycle's actions on one adapter, one port and one bus.

Everything here runs in the thread that calls it (service.py's loop); the relay runs in its own, and so
does the opening of a port, which may take seconds.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import logging
import os
import queue
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

from bridged import _relay
from bridged.adapters import make_adapter
from bridged.adapters.base import Answer, Exchange, Reply, Steps
from bridged.buses import open_bus
from bridged.errors import AdapterError, BusError, PortError, WrongDeviceError
from bridged.lifecycle import Action, Backoff, Event, State, transition
from bridged.polling import HealthPolling
from bridged.ports import open_port
from bridged.status import LOST_BEFORE_READ

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged.adapters.base import Memory
    from bridged.buses import Bus
    from bridged.config import Config
    from bridged.ports import Port

log = logging.getLogger(__name__)

RECONNECT_INITIAL_S = 0.1
RECONNECT_MAXIMUM_S = 5.0
FAULT_RETRY_S = 5.0
BUS_RETRY_S = 1.0
ABORT_WAIT_S = 0.1

REPLIES = {
    _relay.EVENT_OK: Reply.OK,
    _relay.EVENT_REFUSED: Reply.REFUSED,
    _relay.EVENT_TEXT: Reply.TEXT,
    _relay.EVENT_TIMEOUT: Reply.NONE,
}
ACCEPT = {Reply.OK: _relay.ACCEPT_OK, Reply.REFUSED: _relay.ACCEPT_REFUSED}


def _reason(error: int) -> str:
    if error == errno.ETIME:
        return "it took no bytes for too long, and what waited must not be sent late"
    return os.strerror(error) if error else "end of file or hang-up"


class Bridge:
    """Relays between the adapter and the bus of one configuration.

    The owner calls on_readable() when a descriptor of filenos() is readable and on_timer() when
    next_timer() has come (seconds of time.monotonic()), until `finished`.
    """

    def __init__(self, config: Config, memory: Memory) -> None:
        self.config = config
        self.state = State.IDLE
        self.reason = ""  # why the state is not running
        self._told: set[str] = set()  # reasons in the log since it ran last
        self._bus_reason = ""  # why the bus is not open
        self.finished = False
        self.adapter = make_adapter(config, memory)
        self._started = time.monotonic()
        self._port: Port | None = None
        self._bus: Bus | None = None
        self._timer: float | None = None
        self._bus_timer: float | None = None
        self._lost_on_buses: Counter[str] = Counter()  # on buses that were closed since
        self._backoff = Backoff(RECONNECT_INITIAL_S, RECONNECT_MAXIMUM_S)
        self._steps: Steps | None = None
        self._tokens = itertools.count(1)
        self._pending: dict[int, Callable[[Answer], None]] = {}
        self._error_frames = Counter(error_frames=0, error_frames_lost=0)
        self._opened: queue.SimpleQueue[Port | Exception] = queue.SimpleQueue()
        self._opened_fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        sync = self.adapter.sync
        self._relay = _relay.Relay(
            self.adapter.codec,
            queue=config.transmit.queue,
            window=config.transmit.window,
            deadline=config.transmit.deadline_s,
            answer_timeout=self.adapter.answer_timeout_s,
            sync=sync.request,
            sync_prefix=sync.prefix,
        )
        self._polling = HealthPolling(
            self.adapter,
            config.health.interval_s,
            ask=self._ask,
            tell=self._put_error_frame,
            failed=lambda reason: self._dispatch(Event.SILENT, reason),
            overruns=self._overruns,
        )
        self._thread = threading.Thread(target=self._relay.run, name="relay")

    # --- for the owner ------------------------------------------------------------------------

    def start(self) -> None:
        """Starts the relay; the adapter follows when the bus is open."""
        self._thread.start()
        self._open_bus()

    def stop(self) -> None:
        """Closes the adapter, then everything; `finished` says when."""
        self._bus_timer = None
        self._dispatch(Event.STOP)

    def filenos(self) -> tuple[int, int]:
        return self._relay.fileno(), self._opened_fd

    def on_readable(self) -> None:
        try:
            os.eventfd_read(self._opened_fd)
        except BlockingIOError:
            pass
        else:
            self._on_opened()
        for kind, token, text in self._relay.events():
            self._on_event(kind, token, text)

    def next_timer(self) -> float | None:
        return min(
            (t for t in (self._timer, self._bus_timer, self._polling.next_at) if t is not None), default=None
        )

    def on_timer(self, now: float) -> None:
        if self._timer is not None and self._timer <= now:
            self._timer = None
            self._dispatch(Event.TIMER)
        if self._bus_timer is not None and self._bus_timer <= now:
            self._bus_timer = None
            self._open_bus()
        self._polling.on_timer(now)

    def snapshot(self) -> dict[str, Any]:
        """State and counters; see status.py for the meaning of each."""
        counters: dict[str, Any] = self._relay.counters()
        for reason, n in (self._lost_on_buses + self._lost_on_bus()).items():
            if reason in LOST_BEFORE_READ:
                counters["tx_dropped"][reason] = n
            else:  # the relay took it for delivered
                counters["rx_dropped"][reason] = n
                counters["rx_frames"] -= n
        queued = counters.pop("queued")
        identity = self.adapter.identity
        health = self._polling.health
        return {
            "name": self.config.name,
            "state": self.state.value,
            "reason": "; ".join(filter(None, (self.reason, self._bus_reason))),
            "bus_state": health.state.text if health.state is not None else None,
            "tec": health.tec,
            "rec": health.rec,
            "adapter": {
                "type": self.config.adapter.type,
                "port": self.config.adapter.port,
                "version": identity.version,
                "serial_number": identity.serial_number,
            },
            "bus": {
                "interface": self.config.bus.interface,
                "channel": self.config.bus.channel,
                "open": self._bus is not None,
            },
            "counters": {
                "rx_frames": counters.pop("rx_frames"),
                "tx_frames": counters.pop("tx_frames"),
                "rx_errors": counters.pop("skipped_messages"),
                "tx_retries": counters.pop("tx_retries"),
                "bus_off_restarts": health.restarts,
                **health.happened,
                **self._error_frames,
                **counters,
            },
            "queued": queued,
            "uptime_s": round(time.monotonic() - self._started, 3),
        }

    # --- the bus ------------------------------------------------------------------------------

    def _open_bus(self) -> None:
        bus = self.config.bus
        try:
            self._bus = open_bus(bus.interface, bus.channel, create=bus.create, options=bus.options)
        except BusError as error:
            if self._bus_reason != str(error):
                log.error("bus not open: %s; trying again every %g s", error, BUS_RETRY_S)
            self._bus_reason = str(error)
            self._bus_timer = time.monotonic() + BUS_RETRY_S
            return
        self._bus_reason = ""
        if self._bus.warning:
            log.warning("%s", self._bus.warning)
        log.info("bus open: %s", self._bus.description)
        self._relay.attach_bus(self._bus.fd)
        if self.state is State.IDLE:
            self._dispatch(Event.START)

    def _on_bus_lost(self, error: int) -> None:
        if self._bus is None:
            return
        log.error(
            "bus lost: %s: %s; opening it again", self._bus.description, self._bus.failure or _reason(error)
        )
        self._close_bus()
        self._bus_timer = time.monotonic()

    def _lost_on_bus(self) -> Counter[str]:
        return Counter(self._bus.dropped() if self._bus else {})

    def _close_bus(self) -> None:
        if self._bus is None:
            return
        self._relay.detach_bus()
        self._lost_on_buses += self._lost_on_bus()
        self._bus.close()
        self._bus = None

    def _overruns(self) -> int:
        count = self._relay.counters()["rx_overruns"]
        assert isinstance(count, int)
        return count

    def _put_error_frame(self, frame: bytes) -> None:
        """What the bus of the adapter suffers, as a CAN error frame on ours."""
        if not self.config.health.error_frames or self._bus is None:
            return
        try:
            os.write(self._bus.fd, frame)
        except OSError:  # down, full, or gone: the relay notices by itself
            self._error_frames["error_frames_lost"] += 1
        else:
            self._error_frames["error_frames"] += 1

    # --- lifecycle ----------------------------------------------------------------------------

    def _dispatch(self, event: Event, reason: str = "") -> None:
        before = self.state
        self.state, actions = transition(before, event)
        if self.state is not before:
            self._log_transition(reason)
        for action in actions:
            self._perform(action)

    def _log_transition(self, reason: str) -> None:
        """Each cause once: retries that fail for the same one are not told again until it runs."""
        self.reason = reason or (self.reason if self.state in {State.BACKOFF, State.FAULT} else "")
        if self.state is State.RUNNING:
            self._told.clear()
        if reason and reason not in self._told:
            log.warning("state=%s: %s", self.state.value, reason)
            self._told.add(reason)
        else:
            level = logging.DEBUG if self._told else logging.INFO
            log.log(level, "state=%s%s%s", self.state.value, ": " if reason else "", reason)

    def _perform(self, action: Action) -> None:
        match action:
            case Action.OPEN:
                threading.Thread(target=self._open_port, name="open", daemon=True).start()
            case Action.INITIALISE:
                assert self._port is not None
                self._run_steps(self.adapter.init_steps(self._port.serial_number))
            case Action.RUN:
                self._run()
            case Action.CLOSE:
                self._close_channel()
            case Action.RELEASE:
                self._release()
            case Action.WAIT:
                self._timer = time.monotonic() + self._backoff.next_s()
            case Action.WAIT_LONG:
                self._timer = time.monotonic() + FAULT_RETRY_S
            case Action.FINISH:
                self._finish()

    def _open_port(self) -> None:
        result: Port | Exception
        try:
            result = open_port(self.config.adapter.port, self.adapter.baudrate)
        except Exception as error:  # noqa: BLE001 - a bug is raised again in the thread that can end the bridge
            result = error
        self._opened.put(result)
        os.eventfd_write(self._opened_fd, 1)

    def _on_opened(self) -> None:
        result = self._opened.get_nowait()
        if isinstance(result, PortError):
            self._dispatch(Event.OPEN_FAILED, str(result))
            return
        if isinstance(result, Exception):
            raise result
        self._port = result
        self._relay.attach_port(result.fd)
        self._dispatch(Event.OPENED)

    def _run(self) -> None:
        self._backoff.reset()
        if self.adapter.polling is not None:
            polling = self.adapter.polling
            self._relay.set_polling(polling.request, polling.prefix, polling.interval_s)
        if self.adapter.flow is not None:
            flow = self.adapter.flow
            self._relay.set_flow(
                flow.request, flow.prefix, capacity=flow.capacity, critical=flow.critical, ready=flow.ready
            )
        listen_only = self.config.channel.listen_only
        gate = _relay.GATE_LISTEN_ONLY if listen_only else _relay.GATE_OPEN
        self._relay.set_gates(receiving=True, transmit=gate)
        self._polling.start(time.monotonic())
        identity = self.adapter.identity
        log.info("adapter version=%s serial_number=%s", identity.version, identity.serial_number)

    def _close_channel(self) -> None:
        self._polling.stop()
        stopping = self.state is State.STOPPING
        gate = _relay.GATE_STOPPED if stopping else _relay.GATE_AWAY
        self._relay.set_gates(receiving=self._steps is None, transmit=gate)
        self._run_steps(self.adapter.close_steps())

    def _release(self) -> None:
        self._polling.stop()
        self._steps = None
        self._pending.clear()
        self._relay.detach_port()
        for kind, token, text in self._relay.events():  # of the port that is no more, or of the bus
            if kind in {_relay.EVENT_BUS_LOST, _relay.EVENT_BUS_DOWN}:
                self._on_event(kind, token, text)
        if self._port is not None:
            self._port.close()
            self._port = None

    def _finish(self) -> None:
        self._timer = None
        self._relay.set_gates(receiving=False, transmit=_relay.GATE_STOPPED)
        self._relay.stop()
        self._thread.join()
        self.finished = True

    def abort(self) -> None:
        """For an exception that nobody expected: ends the relay, closes the channel as well as may be."""
        self._relay.detach_port()
        self._relay.stop()
        if self._thread.is_alive():
            self._thread.join()
        if self._port is not None:
            with contextlib.suppress(OSError):
                os.write(self._port.fd, self.adapter.last_words)
                time.sleep(ABORT_WAIT_S)  # close() throws away what is not out yet
            self._port.close()
            self._port = None
        self.finished = True

    def close(self) -> None:
        """After `finished`: gives the bus back."""
        self._close_bus()

    # --- exchanges ----------------------------------------------------------------------------

    def _ask(self, exchange: Exchange, then: Callable[[Answer], None]) -> None:
        token = next(self._tokens) & 0xFFFFFFFF
        self._pending[token] = then
        replies = exchange.accept + exchange.reject
        accept = sum(ACCEPT.get(reply, 0) for reply in set(replies))
        self._relay.command(token, exchange.request, accept, exchange.prefix, exchange.timeout_s)

    def _run_steps(self, steps: Steps) -> None:
        """Performs them one after the other; a step that was under way is forgotten, its answer awaited."""
        self._pending.clear()
        self._steps = steps
        self._advance(None)

    def _advance(self, answer: Answer | None) -> None:
        steps = self._steps
        assert steps is not None
        try:
            exchange = steps.send(answer) if answer else next(steps)
        except StopIteration:
            self._steps = None
            self._dispatch(Event.READY if self.state is State.INITIALISING else Event.CLOSED)
        except WrongDeviceError as error:
            self._dispatch(Event.REFUSED, str(error))
        except AdapterError as error:
            self._dispatch(Event.UNANSWERED, str(error))
        else:
            self._ask(exchange, lambda reply: self._on_step_answer(exchange, reply))

    def _on_step_answer(self, exchange: Exchange, answer: Answer) -> None:
        if answer.reply in exchange.accept:
            self._advance(answer)
            return
        advice = f": {exchange.advice}" if exchange.advice else ""
        if answer.reply is Reply.REFUSED:
            self._dispatch(Event.REFUSED, f"the adapter refused to {exchange.purpose}{advice}")
        else:
            wait = f"within {exchange.timeout_s:.2g} s"
            self._dispatch(
                Event.UNANSWERED, f"the adapter did not answer the request to {exchange.purpose} {wait}"
            )

    # --- events of the relay ------------------------------------------------------------------

    def _on_event(self, kind: int, token: int, text: bytes) -> None:
        if kind in REPLIES:
            then = self._pending.pop(token, None)
            if then is not None:
                then(Answer(REPLIES[kind], text))
        elif kind == _relay.EVENT_PORT_LOST:
            failure = self._port.failure if self._port else None
            self._dispatch(
                Event.PORT_LOST, f"port {self.config.adapter.port} lost: {failure or _reason(token)}"
            )
        elif kind == _relay.EVENT_SILENT:
            self._dispatch(Event.SILENT, "the adapter stopped answering")
        elif kind == _relay.EVENT_UNANSWERED:
            log.warning("an answer of the adapter is missing: resynchronising (resyncs=%d)", token)
        elif kind == _relay.EVENT_FRAME_REFUSED:
            self._polling.frame_refused()
        elif kind == _relay.EVENT_STAMPED:
            self.adapter.saw_time_stamps()
        elif kind == _relay.EVENT_BUS_DOWN:
            log.warning("interface %s is down", self.config.bus.channel)
        elif kind == _relay.EVENT_BUS_LOST:
            self._on_bus_lost(token)
        elif kind == _relay.EVENT_NOISE:
            self.adapter.saw_noise(text)
        else:
            self._polling.heard(text)
