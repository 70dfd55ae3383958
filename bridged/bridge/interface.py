"""The CAN interface of one bridge: opened, lost, opened again, down and up again; what the log says of it."""

from __future__ import annotations

import errno
import logging
import math
import os
import time
from collections import Counter
from typing import TYPE_CHECKING

from bridged.bridge.log_limiter import LogLimiter, repeated
from bridged.can import CAN_ERR_BUSOFF, CRTL_RX_OVERFLOW, FRAME
from bridged.errors import InterfaceError
from bridged.interfaces.base import LOST_ERROR_FRAMES

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged import _relay
    from bridged.interfaces.base import OpenInterface
    from bridged.settings import Config

log = logging.getLogger(__name__)

RETRY_S = 1.0
ERROR_FRAME_INTERVAL_S = 0.01


class Interface:
    """Keeps an interface open and attached to the relay, whatever becomes of it.

    The owner calls on_timer() when `next_at` (seconds of time.monotonic()) has come.
    """

    def __init__(
        self, config: Config, relay: _relay.Relay, open_interface: Callable[..., OpenInterface]
    ) -> None:
        self.opened: OpenInterface | None = None
        self.reason = ""  # why it is not open, or carries nothing
        self.retry_at: float | None = None  # the interface is looked for again then
        self._limit = ErrorFrameLimit()
        self._error_frames = Counter(error_frames=0, error_frames_lost=0)
        self._config = config
        self._relay = relay
        self._open_interface = open_interface
        self._log_limiter = LogLimiter()
        self._dropped_before: Counter[str] = Counter()  # by interfaces that were closed since

    def open(self) -> None:
        """Opens it, or tries again later."""
        wanted = self._config.bus
        try:
            opened = self._open_interface(
                wanted.interface, wanted.channel, create=wanted.create, options=wanted.options
            )
        except InterfaceError as error:
            self._not_open(str(error))
            return
        self.use(opened)
        if self.opened is None:
            return
        self._is_well(f"bus open: {opened.description}")
        if opened.warning:
            self.on_down(opened.warning)

    def use(self, opened: OpenInterface, reason: str = "") -> None:
        """An open interface, as that of a bridge that ended; `reason` why it carries nothing: it is down."""
        try:
            self._relay.attach_interface(opened.fd)
        except OSError as error:  # no descriptor is left for it
            self._not_open(f"{opened.description}: {error.strerror}")
            opened.close()
            return
        self.opened = opened
        if reason:
            self.reason = reason
            self.retry_at = time.monotonic() + RETRY_S

    @property
    def is_up(self) -> bool:
        """Whether it is open and carries frames."""
        return self.opened is not None and not self.reason

    def stop_trying(self) -> None:
        """An interface that is not open, or down, is not looked for any more."""
        self.retry_at = None

    def reconfigure(self, config: Config) -> None:
        """Other settings, but for the interface."""
        self._config = config

    @property
    def next_at(self) -> float | None:
        """When on_timer() is to be called."""
        return min((at for at in (self.retry_at, self._limit.next_at) if at is not None), default=None)

    def on_timer(self, now: float) -> bool:
        """Whether the interface has come up, or back."""
        if self._limit.next_at is not None and self._limit.next_at <= now:
            self._put(self._limit.take(now))
        if self.retry_at is None or now < self.retry_at:
            return False
        self.retry_at = None
        if self.opened is None:
            self.open()
        else:
            self._look()
        return not self.reason

    def on_lost(self, error: int) -> None:
        """The relay says so, with the errno of its last call or 0."""
        if self.opened is None:
            return
        cause = self.opened.failure or (os.strerror(error) if error else "end of file")
        hint = f" (was {self._config.bus.channel} deleted?)" if error in {errno.ENODEV, errno.ENXIO} else ""
        self._fails(logging.ERROR, f"bus lost: {self.opened.description}: {cause}{hint}; opening it again")
        self.close()
        self.retry_at = time.monotonic()

    def on_down(self, warning: str = "") -> None:
        """The relay says so. The kernel does not tell when it is up again: that is looked for."""
        if self.opened is None or self.retry_at is not None:
            return
        channel = self._config.bus.channel
        self._fails(logging.WARNING, warning or f"interface {channel} is down: ip link set {channel} up")
        self.retry_at = time.monotonic() + RETRY_S

    def snapshot(self) -> dict[str, object]:
        """For the status."""
        wanted = self._config.bus
        return {
            "interface": wanted.interface,
            "channel": wanted.channel,
            "open": self.opened is not None,
            "up": self.is_up,
        }

    def lost_frames(self) -> Counter[str]:
        """Between the relay and the interface, by reason."""
        lost = self._dropped()
        del lost[LOST_ERROR_FRAMES]
        return lost

    def error_frames(self) -> dict[str, int]:
        """How many are on the interface, and how many it would not have."""
        lost = self._dropped()[LOST_ERROR_FRAMES]
        return {
            "error_frames": self._error_frames["error_frames"] - lost,
            "error_frames_lost": self._error_frames["error_frames_lost"] + lost,
            "error_frames_left_out": self._limit.left_out,
        }

    def _put(self, frames: list[bytes]) -> None:
        if self.opened is None:
            return
        for frame in frames:
            try:
                os.write(self.opened.fd, frame)
            except OSError:  # down, full, or gone: the relay notices by itself
                self._error_frames["error_frames_lost"] += 1
            else:
                self._error_frames["error_frames"] += 1

    def _dropped(self) -> Counter[str]:
        return self._dropped_before + Counter(self.opened.dropped() if self.opened else {})

    def put_error_frame(self, frame: bytes) -> None:
        """A CAN error frame that tells of the adapter's CAN bus; sent soon, if there are many."""
        if self._config.health.error_frames and self.opened is not None:
            self._put(self._limit.add(frame, time.monotonic()))

    def hand_over(self) -> OpenInterface | None:
        """The open interface, for a successor's use(), with `reason`; None: there is none."""
        if self.opened is None:
            return None
        self._put(self._limit.take_all())
        self._relay.detach_interface()
        opened, self.opened = self.opened, None
        return opened

    def close(self) -> None:
        """Idempotent."""
        if self.opened is None:
            return
        self._put(self._limit.take_all())
        self._relay.detach_interface()
        self._dropped_before = self._dropped()
        self.opened.close()
        self.opened = None

    def _look(self) -> None:
        from bridged.interfaces.socketcan import is_up  # noqa: PLC0415 - no other interface is ever down

        channel = self._config.bus.channel
        if is_up(channel):
            self._is_well(f"interface {channel} is up again")
        else:
            self.retry_at = time.monotonic() + RETRY_S

    def _not_open(self, reason: str) -> None:
        self._fails(logging.ERROR, f"bus not open: {reason}")
        self.retry_at = time.monotonic() + RETRY_S

    def _fails(self, level: int, reason: str) -> None:
        self.reason = reason
        times = self._log_limiter.should_log(reason, time.monotonic())
        if times:
            log.log(level, "%s%s", reason, repeated(times))

    def _is_well(self, text: str) -> None:
        self.reason = ""
        log.log(logging.DEBUG if self._log_limiter.quiet else logging.INFO, "%s", text)
        self._log_limiter.recovered()


class ErrorFrameLimit:
    """Error frames for the interface, one of state and one of anything else in ERROR_FRAME_INTERVAL_S.

    Those that come sooner wait until `next_at`: of states the last one, of the others one that says all that
    they say. Times are seconds of any clock.
    """

    def __init__(self) -> None:
        self.next_at: float | None = None
        self.left_out = 0
        self._waiting: dict[bool, bytes] = {}  # by whether it is one of state
        self._free_at = dict.fromkeys((False, True), -math.inf)

    def add(self, frame: bytes, now: float) -> list[bytes]:
        """Those that may go now."""
        is_state = _is_state(frame)
        before = self._waiting.get(is_state)
        if before is not None:
            self.left_out += 1
            if not is_state:
                frame = bytes(a | b for a, b in zip(before, frame, strict=True))
        self._waiting[is_state] = frame
        return self.take(now)

    def take(self, now: float) -> list[bytes]:
        """Those that may go now."""
        frames = []
        for is_state in (False, True):  # a restart before the state after it
            if is_state in self._waiting and now >= self._free_at[is_state]:
                frames.append(self._waiting.pop(is_state))
                self._free_at[is_state] = now + ERROR_FRAME_INTERVAL_S
        self.next_at = min((self._free_at[is_state] for is_state in self._waiting), default=None)
        return frames

    def take_all(self) -> list[bytes]:
        """Those that wait, for an interface that is about to be closed."""
        frames = [self._waiting[is_state] for is_state in sorted(self._waiting)]
        self._waiting.clear()
        self.next_at = None
        return frames


def _is_state(frame: bytes) -> bool:
    can_id, _, data = FRAME.unpack(frame)
    return bool(can_id & CAN_ERR_BUSOFF or data[1] & ~CRTL_RX_OVERFLOW)
