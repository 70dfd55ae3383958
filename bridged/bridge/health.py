"""The state of the CAN bus behind the adapter, from what the adapter says of it: no I/O, no clock."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from bridged.adapters.base import Happened, Observation
from bridged.can import (
    CAN_ERR_BUSERROR,
    CAN_ERR_BUSOFF,
    CAN_ERR_CRTL,
    CAN_ERR_LOSTARB,
    CAN_ERR_PROT,
    CAN_ERR_RESTARTED,
    CRTL_ACTIVE,
    CRTL_RX_OVERFLOW,
    CRTL_RX_PASSIVE,
    CRTL_RX_WARNING,
    CRTL_TX_PASSIVE,
    CRTL_TX_WARNING,
    BusState,
    error_frame,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

CLEAR_S = 1.0
"""A device that only tells what happened is taken for error-active when nothing has happened for so long."""

LARGEST_BUFFER = 64
"""Frames. More than any device that answers each frame has room for."""
STALL_LOOKS = 3


class Finding(NamedTuple):
    """News about the adapter's CAN bus, for bridge.py to act on."""

    error_frames: tuple[bytes, ...] = ()  # for the interface
    failure: str = ""  # why the adapter must be initialised again
    bus_off: str = ""  # why it is bus-off, or is taken for it


class Health:
    """The state of the adapter's CAN bus, from all observations. A value of None is not known."""

    def __init__(self) -> None:
        self.state: BusState | None = None
        self.tec: int | None = None
        self.rec: int | None = None
        self.restarts = 0  # after bus-off
        self.happened: dict[str, int] = {}
        self._reported = BusState.ERROR_ACTIVE  # to the interface
        self.description = ""  # what the adapter said last
        self._heard_s = 0.0
        self._full_s = -math.inf  # when it said last that its transmit buffer was full
        self._seen_s = 0.0  # when `state` was seen last, where it is not lasting

    def forget(self) -> None:
        """The adapter is away: nothing is known."""
        self.state = self.tec = self.rec = None

    def observe(self, seen: Observation, now_s: float) -> list[bytes]:
        """Takes it in. Returns the error frames (struct can_frame) that tell the interface what is new."""
        frames: list[bytes] = []
        self.description = seen.description
        self._heard_s = now_s
        if seen.tec is not None:
            self.tec, self.rec = seen.tec, seen.rec
        if seen.happened is not Happened.NOTHING:  # seldom, and enum.Flag is slow
            if seen.happened & Happened.TX_FULL:
                self._full_s = now_s
            frames += self._happened(seen.happened)
        if self._changed(seen, now_s):
            frames.append(self._state_frame())
        return frames

    def was_full(self, seconds: float) -> bool:
        """Whether the adapter's transmit buffer was full in so many seconds before it was heard last."""
        return self._heard_s - self._full_s <= seconds

    def taken_off(self) -> list[bytes]:
        """The bridge takes the adapter off its CAN bus. Returns the error frames that tell the interface."""
        if self._reported is BusState.BUS_OFF:
            return []
        self._reported = BusState.BUS_OFF
        return [error_frame(CAN_ERR_BUSOFF)]

    def _happened(self, happened: Happened) -> Iterator[bytes]:
        for what in happened:
            name = str(what.name).lower()
            self.happened[name] = self.happened.get(name, 0) + 1
        if happened & Happened.RESTARTED:
            self.restarts += 1
            yield error_frame(CAN_ERR_RESTARTED)
        if notice := _notice(happened):
            yield notice

    def _changed(self, seen: Observation, now_s: float) -> bool:
        before, state = self.state, seen.state
        if state is None:
            return False
        if not seen.lasting:
            if before is not None and state < before and now_s - self._seen_s < CLEAR_S:
                return False
            self._seen_s = now_s
        self.state = state
        news = state != self._reported
        self._reported = state
        return news

    def _state_frame(self) -> bytes:
        """As can_change_state() fills it: both directions where it is not known which has the errors."""
        state = self.state
        if state is BusState.BUS_OFF:
            return error_frame(CAN_ERR_BUSOFF)
        tx, rx = {
            BusState.ERROR_WARNING: (CRTL_TX_WARNING, CRTL_RX_WARNING),
            BusState.ERROR_PASSIVE: (CRTL_TX_PASSIVE, CRTL_RX_PASSIVE),
        }.get(state or BusState.ERROR_ACTIVE, (CRTL_ACTIVE, CRTL_ACTIVE))
        if self.tec is None or self.rec is None:
            return error_frame(CAN_ERR_CRTL, crtl=tx | rx)
        crtl = (tx if self.tec >= self.rec else 0) | (rx if self.tec <= self.rec else 0)
        return error_frame(CAN_ERR_CRTL, crtl=crtl, tec=self.tec, rec=self.rec)


class Stall:
    """Whether frames stay in the transmit buffer of a device that cannot tell how full it is.

    That is taken for certain when it was error-passive (its flag says so once), has received nothing since
    for `limit_s`, and has in that time, or just before, taken frames that may still be in its buffer.
    The frames are counters of those received and taken.
    """

    def __init__(self, limit_s: float, rx_frames: int = 0, tx_frames: int = 0) -> None:
        self.limit_s = limit_s
        self._since_s: float | None = None
        self._looks = 0
        self._rx_frames = rx_frames
        # As of the look before the last good one: what was taken since then may not be on the CAN bus yet.
        self._tx_left = self._tx_seen = tx_frames

    def observe(self, seen: Observation, now_s: float, rx_frames: int, tx_frames: int) -> bool:
        passive = seen.state is BusState.ERROR_PASSIVE
        received = rx_frames != self._rx_frames
        self._rx_frames = rx_frames
        # More than any buffer holds: so the older ones have left it.
        if received or tx_frames - self._tx_left > LARGEST_BUFFER or (self._since_s is None and not passive):
            self._tx_left, self._tx_seen = self._tx_seen, tx_frames
            self._since_s = None
            if not passive:
                return False
        if self._since_s is None:
            self._since_s = now_s
            self._looks = 0
        self._looks += 1
        lasts = self._looks >= STALL_LOOKS and now_s - self._since_s >= self.limit_s
        return lasts and tx_frames > self._tx_left


def _notice(happened: Happened) -> bytes | None:
    classes = 0
    crtl = 0
    if happened & Happened.RX_OVERFLOW:
        classes, crtl = CAN_ERR_CRTL, CRTL_RX_OVERFLOW
    if happened & Happened.ARBITRATION_LOST:
        classes |= CAN_ERR_LOSTARB
    if happened & Happened.BUS_ERROR:
        classes |= CAN_ERR_PROT | CAN_ERR_BUSERROR
    return error_frame(classes, crtl=crtl) if classes else None
