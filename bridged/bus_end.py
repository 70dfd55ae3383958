"""The CAN interface of one bridge: opened, lost, opened again, down and up again; what the log says of it."""

from __future__ import annotations

import errno
import logging
import os
import time
from collections import Counter
from typing import TYPE_CHECKING

from bridged.errors import BusError
from bridged.lifecycle import Told, repeated

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged import _relay
    from bridged.buses import Bus
    from bridged.config import Config

log = logging.getLogger(__name__)

RETRY_S = 1.0


class BusEnd:
    """Keeps a bus open and attached to the relay, whatever becomes of the interface.

    The owner calls on_timer() when `next_at` (seconds of time.monotonic()) has come.
    """

    def __init__(self, config: Config, relay: _relay.Relay, open_bus: Callable[[], Bus]) -> None:
        self.bus: Bus | None = None
        self.reason = ""  # why it is not open, or carries nothing
        self.next_at: float | None = None
        self.error_frames = Counter(error_frames=0, error_frames_lost=0)
        self._config = config
        self._relay = relay
        self._open_bus = open_bus
        self._told = Told()
        self._lost_before: Counter[str] = Counter()  # frames, on buses that were closed since

    def open(self) -> None:
        """Opens it, or tries again later."""
        try:
            bus = self._open_bus()
        except BusError as error:
            self._fails(logging.ERROR, f"bus not open: {error}")
            self.next_at = time.monotonic() + RETRY_S
            return
        self._is_well(f"bus open: {bus.description}")
        self.use(bus)
        if bus.warning:
            self.on_down(bus.warning)

    def use(self, bus: Bus) -> None:
        """An open bus of a bridge that ended."""
        self.bus = bus
        self._relay.attach_bus(bus.fd)

    def adopt(self, config: Config) -> None:
        """Other settings, but for the interface."""
        self._config = config

    def on_timer(self, now: float) -> bool:
        """Whether the interface has come up, or back."""
        if self.next_at is None or now < self.next_at:
            return False
        self.next_at = None
        if self.bus is None:
            self.open()
        else:
            self._look()
        return not self.reason

    def on_lost(self, error: int) -> None:
        """The relay says so, with the errno of its last call or 0."""
        if self.bus is None:
            return
        cause = self.bus.failure or (os.strerror(error) if error else "end of file")
        hint = f" (was {self._config.bus.channel} deleted?)" if error in {errno.ENODEV, errno.ENXIO} else ""
        self._fails(logging.ERROR, f"bus lost: {self.bus.description}: {cause}{hint}; opening it again")
        self.close()
        self.next_at = time.monotonic()

    def on_down(self, warning: str = "") -> None:
        """The relay says so. The kernel does not tell when it is up again: that is looked for."""
        if self.bus is None or self.next_at is not None:
            return
        channel = self._config.bus.channel
        self._fails(logging.WARNING, warning or f"interface {channel} is down: ip link set {channel} up")
        self.next_at = time.monotonic() + RETRY_S

    def lost_frames(self) -> Counter[str]:
        """Between the relay and the interface, by reason."""
        return self._lost_before + Counter(self.bus.dropped() if self.bus else {})

    def put_error_frame(self, frame: bytes) -> None:
        """What the bus of the adapter suffers, as a CAN error frame on ours."""
        if not self._config.health.error_frames or self.bus is None:
            return
        try:
            os.write(self.bus.fd, frame)
        except OSError:  # down, full, or gone: the relay notices by itself
            self.error_frames["error_frames_lost"] += 1
        else:
            self.error_frames["error_frames"] += 1

    def hand_over(self) -> Bus | None:
        """The open bus, for a successor's use(); None: there is none, or it is down, which open() tells."""
        if self.bus is None or self.reason:
            return None
        self._relay.detach_bus()
        bus, self.bus = self.bus, None
        return bus

    def close(self) -> None:
        """Idempotent."""
        if self.bus is None:
            return
        self._relay.detach_bus()
        self._lost_before = self.lost_frames()
        self.bus.close()
        self.bus = None

    def _look(self) -> None:
        from bridged.buses.socketcan import is_up  # noqa: PLC0415 - no other interface is ever down

        channel = self._config.bus.channel
        if is_up(channel):
            self._is_well(f"interface {channel} is up again")
        else:
            self.next_at = time.monotonic() + RETRY_S

    def _fails(self, level: int, reason: str) -> None:
        self.reason = reason
        times = self._told.tell(reason, time.monotonic())
        if times is not None:
            log.log(level, "%s%s", reason, repeated(times))

    def _is_well(self, text: str) -> None:
        self.reason = ""
        log.log(logging.DEBUG if self._told.quiet else logging.INFO, "%s", text)
        self._told.well()
