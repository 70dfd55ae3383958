"""One bridge: performs the lifecycle's actions on one adapter, one port and one interface.

Everything here runs in the thread that calls it (service.py's loop); the relay runs in its own, and so
does the opening of a port, which may take seconds.
"""

from __future__ import annotations

import errno
import logging
import os
import time
from collections import deque
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from bridged import _relay
from bridged.adapters import make_adapter
from bridged.bridge.exchanges import REPLIES, Exchanges
from bridged.bridge.hand_over import HandOver
from bridged.bridge.health import Finding
from bridged.bridge.interface import Interface
from bridged.bridge.lifecycle import (
    AWAITING_DEVICE,
    COMING_UP,
    FAILING,
    Action,
    Event,
    Lifecycle,
    State,
    Verdict,
)
from bridged.bridge.loop import RelayLoop
from bridged.bridge.polling import NOISE, NOISE_CAUSES, HealthPolling
from bridged.bridge.port import AdapterPort
from bridged.bridge.recovery import Recovery, stuck_s
from bridged.bridge.snapshot import History, settle
from bridged.can import BusState
from bridged.interfaces import open_interface as open_any_interface
from bridged.ports import open_port as open_any_port
from bridged.ports.watch import Watch
from bridged.settings import Restart

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged.adapters.base import Memory
    from bridged.bridge.exchanges import Found
    from bridged.interfaces.base import OpenInterface
    from bridged.ports import Port
    from bridged.settings import Config

log = logging.getLogger(__name__)


def _reason(error: int) -> str:
    if error == errno.ETIME:
        return "it took no bytes for too long, and what waited must not be sent late"
    return os.strerror(error) if error else "end of file or hang-up"


class Bridge:
    """Relays between the adapter and the interface of one configuration.

    The owner calls on_readable() when a descriptor of filenos() is readable and on_timer() when
    next_timer() has come (seconds of time.monotonic()), until `finished`.

    `open_port` gets the port and the baud rate, and is called in a thread of its own; `open_interface` gets
    the settings of bridged.interfaces.open_interface(). `watch` tells when the port's device is plugged in.
    """

    def __init__(
        self,
        config: Config,
        memory: Memory,
        *,
        open_port: Callable[[str, int], Port] = open_any_port,
        open_interface: Callable[..., OpenInterface] = open_any_interface,
        watch: Watch | None = None,
    ) -> None:
        self.config = config
        self.circle = ""  # what neighbours.py has found
        self.adapter = make_adapter(config, memory)
        self._life = Lifecycle(config.reconnect)
        self._history = History()
        self._loop = RelayLoop(config, self.adapter)
        relay = self._loop.relay
        self._interface = Interface(config, relay, open_interface)
        self._hand_over = HandOver(relay)
        watch = watch or Watch(config.adapter.port, config.adapter.usb_serial_number)
        self._port = AdapterPort(config.adapter, relay, open_port, watch)
        self._exchanges = Exchanges(relay)
        self._polling = HealthPolling(
            self.adapter,
            config.health.interval_s,
            ask=self._exchanges.ask,
            stuck_s=stuck_s(config),
            tally=relay.tally,
        )
        self._recovery = Recovery(config, self.adapter)

    # --- for the owner ------------------------------------------------------------------------

    @property
    def state(self) -> State:
        return self._life.state

    @property
    def reason(self) -> str:
        """Why the state is not running."""
        return self._life.reason

    @property
    def finished(self) -> bool:
        """It has ended, and only waits for close()."""
        return self._loop.finished

    @property
    def settled(self) -> bool:
        """`finished`, and no port is being opened any more that would be in a successor's way."""
        return self.finished and not self._port.is_opening

    def start(self, predecessor: Bridge | None = None) -> None:
        """Starts the relay; the adapter follows when the interface is open.

        `predecessor`: one that was told its successor by stop() and is settled. Its counters go on, so does
        its interface: frames that wait there are read once the adapter runs, or fails to.
        """
        self._loop.start()
        opened = None
        if predecessor is not None:
            opened = predecessor._give_interface(self.config)
            self._port.take_over(predecessor._port)
            predecessor.close()
            self._history.continue_from(predecessor._history, predecessor.snapshot()["counters"])
        if opened is None:
            self._interface.open()
        else:
            self._hand_over.await_adapter()
            assert predecessor is not None
            self._interface.use(opened, predecessor._interface.reason)
        self._start_with_interface()

    def stop(self, successor: Config | None = None) -> None:
        """Closes the adapter, then everything; `finished` says when.

        `successor`: the configuration of the bridge that goes on. If it has the same interface, frames wait
        in that from now on, and those that were read before are sent first, if that does not take long.
        """
        self._interface.stop_trying()
        if successor is not None and successor.bus == self.config.bus:
            self._hand_over.prepare(time.monotonic(), running=self.state is State.RUNNING)
        else:
            self._hand_over.cancel()
        self._stop_when_sent(time.monotonic())

    def abort(self) -> None:
        """For an exception that nobody expected: ends the relay, closes the channel as well as may be."""
        self._loop.end()
        self._port.last_words(self.adapter.last_words)
        self._port.abort()

    def close(self) -> None:
        """After `finished`, or instead of start(): gives back what it holds."""
        self._port.close()
        self._interface.close()

    def filenos(self) -> tuple[int, ...]:
        return self._loop.relay.fileno(), *self._port.filenos()

    def on_readable(self) -> None:
        self._act_on(self._port.on_readable(wanted=not self.finished))
        for kind, token, text in self._loop.relay.events():
            self._act_on(self._find(kind, token, text))
        if self.state in AWAITING_DEVICE and self._port.has_come():
            self._act_on(Verdict(Event.APPEARED))

    def next_timer(self) -> float | None:
        parts = (self._life, self._hand_over, self._interface, self._polling, self._exchanges, self._port)
        return min((part.next_at for part in parts if part.next_at is not None), default=None)

    def on_timer(self, now: float) -> None:
        if self._life.has_timed_out(now):
            self._act_on(Verdict(Event.TIMER))
        if self._hand_over.next_at is not None and self._hand_over.next_at <= now:
            self._stop_when_sent(time.monotonic())
        if self._interface.on_timer(now):
            self._act_on(Verdict(Event.RESTART))
        self._start_with_interface()
        self._polling.on_timer(now)
        self._act_on(self._exchanges.on_timer(now))
        self._port.on_timer(now)

    def has_turned(self) -> bool:
        """Whether the relay ran since the last call. Wakes it, so that the next call can tell."""
        return self._loop.has_turned()

    def reconfigure(self, config: Config) -> bool:
        """Goes on with other settings; False: with these it cannot, a new bridge must take its place."""
        present = self.config
        transmit = replace(
            present.transmit, queue=config.transmit.queue, deadline_s=config.transmit.deadline_s
        )
        channel = replace(present.channel, restart=config.channel.restart)
        if config != replace(
            present,
            channel=channel,
            transmit=transmit,
            health=config.health,
            reconnect=config.reconnect,
            notify=config.notify,
        ):
            return False
        self.config = config
        self._loop.reconfigure(config)
        self._interface.reconfigure(config)
        self._recovery.reconfigure(config)
        self._polling.reconfigure(config.health.interval_s, stuck_s(config))
        self._life.reconfigure(config.reconnect, time.monotonic())
        if channel.restart is not Restart.NEVER:
            self._act_on(Verdict(Event.RESTART))
        if self._polling.health.state is BusState.BUS_OFF:
            self._act_on(Finding(bus_off="bus-off"))
        return True

    # --- what it tells ------------------------------------------------------------------------

    def rates(self) -> dict[str, float]:
        """Frames a second each way."""
        return self._polling.rates()

    def frames_read(self) -> int:
        """From the interface, by this bridge alone."""
        read: Any = self._loop.relay.counters()["bus_read"]
        return int(read)

    def glimpse(self) -> tuple[bytes, bytes]:
        """A frame that came from the interface lately and one that went to it."""
        return self._loop.relay.glimpse()

    def condition(self) -> tuple[State, str, bool]:
        """The state, the reason why it is not running, whether the interface is open."""
        reason = "; ".join(filter(None, (self.reason, self._interface.reason, self.circle)))
        return self.state, reason, self._interface.opened is not None

    def bus_state(self) -> BusState | None:
        """That of the CAN bus; None: not known."""
        return self._polling.health.state

    def snapshot(self) -> dict[str, Any]:
        """State and counters; see status.py for the meaning of each."""
        lost = self._interface.lost_frames()  # before the relay's, so that each of them is in those
        counters: dict[str, Any] = self._loop.relay.counters()
        settle(counters, lost)
        queued = counters.pop("queued")
        health, adapter = self._polling.health, self.adapter
        counted = {
            "rx_frames": counters.pop("rx_frames"),
            "tx_frames": counters.pop("tx_frames"),
            "tx_queued": counters.pop("tx_queued"),
            "tx_unconfirmed": counters.pop("tx_unconfirmed"),
            "rx_errors": counters.pop("skipped_messages"),
            "tx_retries": counters.pop("tx_retries"),
            "reconnects": max(0, self._history.starts - 1),
            "bus_off_restarts": health.restarts,
            **health.happened,
            **self._interface.error_frames(),
            "tx_discarded": adapter.discarded,
            **counters,
        }
        state, reason, _ = self.condition()
        return {
            "name": self.config.name,
            "state": state.value,
            "reason": reason,
            # One that closing does not take off its bus is on it from the first moment.
            "channel_open": self._exchanges.channel_open if adapter.stops else True,
            **self._polling.snapshot(),
            "adapter": {
                "type": self.config.adapter.type,
                "port": self.config.adapter.port,
                "opened": self._port.port.description if self._port.port else None,
                **adapter.identity._asdict(),
                "sent_means": adapter.sent_means,
            },
            "bus": self._interface.snapshot(),
            "counters": self._history.total(counted),
            "queued": queued,
            "uptime_s": self._history.uptime_s(),
        }

    # --- lifecycle ----------------------------------------------------------------------------

    def _start_with_interface(self) -> None:
        if self.state is State.IDLE and self._interface.opened is not None:
            self._act_on(Verdict(Event.START))

    def _stop_when_sent(self, now: float) -> None:
        """A bridge that hands its interface over stops when it has sent what it has read, or cannot."""
        if self._hand_over.may_stop(now, running=self.state is State.RUNNING):
            self._act_on(Verdict(Event.STOP))

    def _give_interface(self, successor: Config) -> OpenInterface | None:
        """The open interface; None: it was lost, or the successor wants another."""
        if successor.bus != self.config.bus:
            return None
        if any(kind == _relay.EVENT_INTERFACE_LOST for kind, _, _ in self._loop.relay.events()):
            return None
        return self._interface.hand_over()

    def _act_on(self, found: Found) -> None:
        """Acts on news of any part, and on what that leads to, one after the other.

        An action returns what it finds, and calls nobody here: so an event that an action leads to waits
        until all actions before it are done.
        """
        pending = deque([self._decide(found)])
        while pending:
            verdict = pending.popleft()
            if verdict is None:
                continue
            for action in self._enter(verdict):
                pending.append(self._decide(self._perform(action)))
            if self.state not in COMING_UP:
                self._hand_over.adapter_is_decided()

    def _stuck(self, verdict: Verdict | None) -> Verdict | None:
        """Counts the frames that stay in the adapter, where it keeps its buffer."""
        if verdict is not None:
            self._loop.relay.count_late(self.adapter.sending.kept)
        return verdict

    def _decide(self, found: Found) -> Verdict | None:
        """The event that the news are in the present state; tells the interface what concerns it."""
        if isinstance(found, Finding):
            for frame in found.error_frames:
                self._interface.put_error_frame(frame)
            if found.failure:
                return Verdict(Event.SILENT, found.failure)
            if not found.bus_off or self.state is not State.RUNNING:
                return None
            found = self._stuck(self._recovery.bus_off(found.bus_off))
        if found is not None and found.off_bus:
            for frame in self._polling.taken_off().error_frames:
                self._interface.put_error_frame(frame)
        return found

    def _enter(self, verdict: Verdict) -> tuple[Action, ...]:
        """Enters the next state; what is to be done in it."""
        before = self.state
        actions = self._life.take(verdict)
        if self.state is before:
            return actions
        now, reason = time.monotonic(), verdict.reason
        there_is_noise = self._polling.heard_noise()
        if self.state in FAILING:
            self._port.suspect_others(now)
            if there_is_noise and reason:
                reason += f"; there is {NOISE} ({NOISE_CAUSES})"
        self._life.log_change(reason, now)
        return actions

    def _perform(self, action: Action) -> Found:
        self._life.schedule(action, time.monotonic())
        match action:
            case Action.LOOK:
                self._port.watch_for_device()
                return Verdict(Event.APPEARED) if self._port.is_there() else None
            case Action.OPEN:
                self._port.open(self.adapter.baudrate)
            case Action.INITIALISE:
                port = self._port.port
                assert port is not None
                return self._exchanges.run(
                    self.adapter.init_steps(port.serial_number, port.product), Event.READY
                )
            case Action.RUN:
                return self._run()
            case Action.CLOSE:
                return self._close_channel()
            case Action.LAST_WORDS:
                log.warning("the adapter did not answer in time: its channel may still be open")
                self._port.last_words(self.adapter.last_words)
            case Action.RELEASE:
                self._release()
            case Action.WAIT | Action.WAIT_LONG:
                self._port.watch_for_device()
            case Action.FINISH:
                self._finish()
        return None

    def _run(self) -> Found:
        self._port.adapter_runs()
        self._loop.open_gates(self.adapter, listen_only=self.config.channel.listen_only)
        finding = self._polling.start(time.monotonic(), restarted=self._life.is_restart)
        self._history.adapter_runs(self.adapter)
        return finding

    def _close_channel(self) -> Found:
        bus_state = self._polling.health.state
        self._polling.stop()
        stopping = self.state is State.STOPPING
        # What one that is error-passive has taken may be there for long. (Some firmware does not tell.)
        drain = stopping and (bus_state is None or bus_state < BusState.ERROR_PASSIVE)
        self._loop.close_gates(receiving=not self._exchanges.running, stopping=stopping)
        return self._exchanges.run(self.adapter.close_steps(drain), Event.CLOSED)

    def _release(self) -> None:
        self._recovery.closed()
        self._polling.stop()
        self._exchanges.forget()
        self._port.release()
        for (
            kind,
            token,
            text,
        ) in self._loop.relay.events():  # of the port that is no more, or of the interface
            if kind in {_relay.EVENT_INTERFACE_LOST, _relay.EVENT_INTERFACE_DOWN}:
                self._find(kind, token, text)

    def _finish(self) -> None:
        self._port.stop_watching()
        self._loop.close_gates(receiving=False, stopping=True)
        self._loop.end()

    # --- events of the relay ------------------------------------------------------------------

    def _find(self, kind: int, token: int, text: bytes) -> Found:
        """Hands an event to the part that it concerns; what that part finds."""
        if kind in REPLIES:
            return self._exchanges.answer(kind, token, text)
        if kind == _relay.EVENT_PORT_LOST:
            port = self._port.port
            failure = port.failure if port else None
            reason = f"port {self.config.adapter.port} lost: {failure or _reason(token)}"
            return Verdict(Event.PORT_LOST, reason)
        if kind == _relay.EVENT_SILENT:
            return Verdict(Event.SILENT, "the adapter stopped answering")
        if kind == _relay.EVENT_STUCK:
            if self.state is not State.RUNNING:
                return None
            return self._stuck(self._recovery.stuck(token, self._polling))
        if kind == _relay.EVENT_UNASKED:
            return self._polling.heard(text)
        now = time.monotonic()
        if kind == _relay.EVENT_UNANSWERED:
            self._port.suspect_others(now)
            self._recovery.unanswered(token, now)
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
            self._port.suspect_others(now)
        return None
