"""The relay of one bridge and the thread that it runs in."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from bridged import _relay
from bridged.bridge.recovery import stuck_s

if TYPE_CHECKING:
    from bridged.adapters.base import Adapter, Sending
    from bridged.settings import Config


def set_sending(relay: _relay.Relay, sending: Sending) -> None:
    """How the adapter wants its frames; until its port is detached."""
    relay.set_sending(
        sending.confirms.value,
        sending.remote.value,
        window=sending.window or 0,
        bitrate=sending.paced_bitrate or 0,
        depth=sending.depth,
        retries=sending.retries,
        long_stamps=sending.long_stamps,
    )


class RelayLoop:
    """Makes a relay for an adapter, and runs it in a thread of its own from start() to end()."""

    def __init__(self, config: Config, adapter: Adapter) -> None:
        sync = adapter.sync
        self.relay = _relay.Relay(
            adapter.codec,
            queue=config.transmit.queue,
            window=config.transmit.window,
            deadline=config.transmit.deadline_s,
            stuck=stuck_s(config),
            answer_timeout=adapter.answer_timeout_s,
            sync=sync.request,
            sync_prefix=sync.prefix,
        )
        self.finished = False
        self._thread = threading.Thread(target=self.relay.run, name="relay")
        self._turns: object = None  # of the relay, when they were looked at last

    def start(self) -> None:
        self._thread.start()

    def end(self) -> None:
        """Ends the thread, if it was started."""
        self.relay.stop()
        if self._thread.is_alive():
            self._thread.join()
        self.finished = True

    def has_turned(self) -> bool:
        """Whether the relay ran since the last call. Wakes it, so that the next call can tell.

        Waits if the relay hangs with its lock held.
        """
        turns, self._turns = self._turns, self.relay.counters()["turns"]
        self.relay.wake()
        return turns != self._turns

    def reconfigure(self, config: Config) -> None:
        """Goes on with another section `transmit`, but for its window."""
        self.relay.set_queue(config.transmit.queue, config.transmit.deadline_s, stuck_s(config))

    def open_gates(self, adapter: Adapter, *, listen_only: bool) -> None:
        """The adapter runs: frames go both ways, in the manner that its initialisation has found out."""
        if adapter.polling is not None:
            polling = adapter.polling
            self.relay.set_polling(polling.request, polling.prefix, polling.interval_s)
        sync = adapter.sync
        self.relay.set_sync(sync.request, sync.prefix)
        set_sending(self.relay, adapter.sending)
        if adapter.flow is not None:
            flow = adapter.flow
            self.relay.set_level_window(
                flow.request, flow.prefix, capacity=flow.capacity, critical=flow.critical, ready=flow.ready
            )
        gate = _relay.GATE_LISTEN_ONLY if listen_only else _relay.GATE_OPEN
        self.relay.set_gates(receiving=True, transmit=gate)

    def close_gates(self, *, receiving: bool, stopping: bool) -> None:
        """Frames from the interface are dropped; those of the adapter too, unless `receiving`."""
        gate = _relay.GATE_STOPPED if stopping else _relay.GATE_AWAY
        self.relay.set_gates(receiving=receiving, transmit=gate)
