"""What an adapter's answers say about its CAN bus, and how SocketCAN programs are told: no I/O, no clock.

A change of state becomes a CAN error frame as the kernel's drivers make them (linux/can/error.h and
can_change_state in drivers/net/can/dev): error counters in data[6] and data[7], and the direction that the
state comes from, if the counters are known. Without CAN_ERR_CNT, which says that there are counters: it is
as new as Linux 6.0, and can-utils of before (Debian 12's) refuse to decode a frame that has it.
"""

from __future__ import annotations

import enum
import math
import struct
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator

WARNING_LIMIT = 96
PASSIVE_LIMIT = 128

CLEAR_S = 1.0
"""A device that only tells what happened is taken for error-active when nothing has happened for so long."""

CAN_ERR_FLAG = 0x20000000
CAN_ERR_LOSTARB, CAN_ERR_CRTL, CAN_ERR_PROT = 0x002, 0x004, 0x008
CAN_ERR_BUSOFF, CAN_ERR_BUSERROR, CAN_ERR_RESTARTED = 0x040, 0x080, 0x100
CRTL_RX_OVERFLOW, CRTL_ACTIVE = 0x01, 0x40
CRTL_RX_WARNING, CRTL_TX_WARNING, CRTL_RX_PASSIVE, CRTL_TX_PASSIVE = 0x04, 0x08, 0x10, 0x20

LARGEST_BUFFER = 64
"""Frames. More than a CAN232 (8) or any clone has room for."""
STALL_LOOKS = 3

ERROR_FRAME_INTERVAL_S = 0.01

_FRAME = struct.Struct("=IB3x8s")  # struct can_frame


class BusState(enum.IntEnum):
    """Of a CAN controller (ISO 11898-1); ordered."""

    ERROR_ACTIVE = 0
    ERROR_WARNING = 1
    ERROR_PASSIVE = 2
    BUS_OFF = 3

    @property
    def text(self) -> str:
        return self.name.lower().replace("_", "-")


class Happened(enum.Flag):
    """What can have happened since the last look."""

    NOTHING = 0
    TX_FULL = enum.auto()
    RX_OVERFLOW = enum.auto()
    ARBITRATION_LOST = enum.auto()
    BUS_ERROR = enum.auto()
    RESTARTED = enum.auto()


class Observation(NamedTuple):
    """What an adapter said of its bus. `state` None: it did not say; counters None: it cannot."""

    description: str
    state: BusState | None = None
    lasting: bool = True  # False: `state` is the worst there was since the last look, not what is now
    tec: int | None = None
    rec: int | None = None
    happened: Happened = Happened.NOTHING


UNKNOWN = Observation("unknown")
"""It did not answer."""


def state_of(tec: int, rec: int) -> BusState:
    """The state that these error counters mean; bus-off cannot be told by them."""
    worst = max(tec, rec)
    if worst >= PASSIVE_LIMIT:
        return BusState.ERROR_PASSIVE
    return BusState.ERROR_WARNING if worst >= WARNING_LIMIT else BusState.ERROR_ACTIVE


class Health:
    """The state of the bus, from all observations; None: not known."""

    def __init__(self) -> None:
        self.state: BusState | None = None
        self.tec: int | None = None
        self.rec: int | None = None
        self.restarts = 0  # after bus-off
        self.happened: dict[str, int] = {}
        self._told = BusState.ERROR_ACTIVE  # to the bus
        self._seen_s = 0.0  # when `state` was seen last, where it is not lasting

    def forget(self) -> None:
        """The adapter is away: nothing is known."""
        self.state = self.tec = self.rec = None

    def observe(self, seen: Observation, now_s: float) -> list[bytes]:
        """Take it in; the error frames (struct can_frame) that tell the bus what is new."""
        frames: list[bytes] = []
        if seen.tec is not None:
            self.tec, self.rec = seen.tec, seen.rec
        if seen.happened is not Happened.NOTHING:  # seldom, and enum.Flag is slow
            frames += self._happened(seen.happened)
        if self._changed(seen, now_s):
            frames.append(self._state_frame())
        return frames

    def taken_off(self) -> list[bytes]:
        """The bridge takes the adapter off its CAN bus, whatever that says; the error frames for it."""
        if self._told is BusState.BUS_OFF:
            return []
        self._told = BusState.BUS_OFF
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
        news = state != self._told
        self._told = state
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
        # As of the look before the last good one: what was taken since then may not be on the bus yet.
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
        """Those that may go now; with math.inf all."""
        frames = []
        for is_state in (False, True):  # a restart before the state after it
            if is_state in self._waiting and now >= self._free_at[is_state]:
                frames.append(self._waiting.pop(is_state))
                self._free_at[is_state] = now + ERROR_FRAME_INTERVAL_S
        self.next_at = min((self._free_at[is_state] for is_state in self._waiting), default=None)
        return frames


def _is_state(frame: bytes) -> bool:
    can_id, _, data = _FRAME.unpack(frame)
    return bool(can_id & CAN_ERR_BUSOFF or data[1] & ~CRTL_RX_OVERFLOW)


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


def error_frame(classes: int, *, crtl: int = 0, tec: int = 0, rec: int = 0) -> bytes:
    """A `struct can_frame` of these error classes (linux/can/error.h)."""
    return _FRAME.pack(CAN_ERR_FLAG | classes, 8, bytes((0, crtl, 0, 0, 0, 0, tec, rec)))
