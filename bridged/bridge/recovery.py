"""Decides about an adapter that is bus-off, seems to be, or takes no frames: `channel.restart`."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

from bridged.bridge.backoff import Backoff, chance
from bridged.bridge.lifecycle import Event, Verdict
from bridged.bridge.log_limiter import LogLimiter, repeated
from bridged.settings import After, Restart

if TYPE_CHECKING:
    from bridged.adapters.base import Adapter
    from bridged.bridge.polling import HealthPolling
    from bridged.settings import Config

log = logging.getLogger(__name__)

STUCK_LEAST_S = 0.5  # a slow, busy CAN bus is no reason
UNANSWERED_LOG_S = 10.0
REFUSING_S, REFUSING_LONGEST_S = 60.0, 3600.0

REOPENED = "; the channel is closed and opened anew"
EMPTIED = ", which throws away what is in the adapter's buffer, so that nothing is sent late"
KEPT = ", which leaves what is in the adapter's buffer: that may be sent late; unplug it to prevent that"


def stuck_s(config: Config) -> float:
    """If no frame leaves the adapter for so long, those in its buffer are older than the deadline."""
    return max(config.transmit.deadline_s, STUCK_LEAST_S)


class Recovery:
    """Decides for a running adapter; the owner acts on the verdict. None: nothing is to be done.

    Frames that wait in the adapter's own buffer would be sent whenever its CAN bus lets them, however old: so
    the channel is closed in any case.
    """

    def __init__(self, config: Config, adapter: Adapter) -> None:
        self._config = config
        self._adapter = adapter
        # For an adapter that refuses every frame though its buffer is not full. Initialising it again may
        # help, or not: perhaps it does not know such frames. So that is done more and more rarely.
        self._refusing = Backoff(REFUSING_S, REFUSING_LONGEST_S, chance)
        self._refusing_until = 0.0
        self._discarded = 0  # frames, those that the log has
        self._log_limiter = LogLimiter()
        self._unanswered_limiter = LogLimiter(UNANSWERED_LOG_S)

    def reconfigure(self, config: Config) -> None:
        """Other settings, but for the interface."""
        self._config = config

    def bus_off(self, cause: str) -> Verdict | None:
        """The adapter is bus-off, or cannot tell whether it is."""
        restart = self._config.channel.restart
        if isinstance(restart, After):
            return Verdict(Event.SILENT, f"{cause}{self._reopened()}", restart.seconds, off_bus=True)
        if restart is Restart.ITSELF:
            return None
        interface = self._config.bus
        how = "a new start of the bridge"
        if interface.interface == "socketcan":
            how = f"ip link set {interface.channel} down, then up,"
        reason = f"{cause}; channel.restart is never: {how} puts it on the bus again"
        return Verdict(Event.BUS_OFF, reason, off_bus=True)

    def _reopened(self) -> str:
        return REOPENED + (KEPT if self._adapter.sending.keeps_buffer else EMPTIED)

    def stuck(self, frames: int, polling: HealthPolling) -> Verdict | None:
        """The adapter has taken no frame for stuck_s(), or none has left it.

        `frames` are in its buffer, if it tells.
        """
        now = time.monotonic()
        limit_s = stuck_s(self._config)
        pause_s = self._config.reconnect.initial_s
        cause = f"no frame has left the adapter for {limit_s:g} s"
        if self._adapter.flow is not None:
            why = "does another node acknowledge them? Is it in listen-only mode, or the bus always busy?"
            reason = f"{cause}, {frames} are in its buffer ({why}){self._reopened()}"
            return Verdict(Event.SILENT, reason, pause_s)
        if polling.was_full(limit_s) or not self._adapter.tells_full:  # it cannot tell bus-off
            return self.bus_off(
                f"{cause} (does another node acknowledge them?), its status: {polling.health.description}"
            )
        if now < self._refusing_until:
            return None
        self._refusing_until = now + self._refusing.next_s(now)
        reason = (
            f"the adapter refuses every frame, its status: {polling.health.description} "
            "(is it in listen-only mode?); it is initialised anew"
        )
        return Verdict(Event.SILENT, reason, pause_s)

    def unanswered(self, resyncs: int, now: float) -> None:
        """An answer is missing, for the n-th time: logs that the relay resynchronises the line."""
        times = self._unanswered_limiter.should_log("unanswered", now)
        self._unanswered_limiter.recovered()
        if times:
            log.warning("no answer from the adapter: resynchronising (resyncs=%d)", resyncs)

    def closed(self) -> None:
        """The adapter's channel is closed: logs how many frames were thrown away with its buffer."""
        frames, self._discarded = self._adapter.discarded - self._discarded, self._adapter.discarded
        times = self._log_limiter.should_log("discarded", time.monotonic()) if frames else 0
        if times:
            text = "frames did not leave the adapter before its channel was closed: they are thrown away"
            log.warning("%d %s%s", frames, text, repeated(times))
