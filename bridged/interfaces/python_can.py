"""Every other python-can interface (`virtual`, `udp_multicast`, `pcan`, ...), pumped through a socketpair."""

from __future__ import annotations

import contextlib
import logging
import socket
import struct
import traceback
import uuid
from typing import TYPE_CHECKING, Any, Final

import can

from bridged.errors import InterfaceError
from bridged.interfaces.backends import missing_package
from bridged.interfaces.base import LOST_ERROR_FRAMES
from bridged.interfaces.socketcan import receive_stamped, set_buffers
from bridged.ports.pump import POLL_INTERVAL_S, Pump

if TYPE_CHECKING:
    from collections.abc import Mapping

# linux/can.h, for frames with the arbitration id in host order
_CAN_FRAME: Final = struct.Struct("=IB2xB8s")  # can_id, len, len8_dlc, data
_CANFD_FRAME: Final = struct.Struct("=IBB2x64s")  # can_id, len, flags, data
_CAN_EFF_FLAG: Final = 0x80000000
_CAN_RTR_FLAG: Final = 0x40000000
_CAN_ERR_FLAG: Final = 0x20000000
_CAN_EFF_MASK: Final = 0x1FFFFFFF
_CAN_SFF_MASK: Final = 0x7FF
_CAN_MAX_DLEN: Final = 8
_CANFD_MAX_DLEN: Final = 64
_CANFD_BRS: Final = 0x01
_CANFD_ESI: Final = 0x02
_CANFD_FDF: Final = 0x04

_RECV_FAILURES_MAX: Final = 10  # in a row: one bad message is data, ten over a second are a dead bus
_RECV_PAUSE_S: Final = 0.1

# Software buses, where an error frame is a message like any other. A controller cannot be told to send one,
# and some drivers would send its content as a data frame.
_CARRY_ERROR_FRAMES: Final = frozenset({"udp_multicast", "virtual"})
# Gives each sender its own frames back and does not mark them (Message.is_rx); but `channel` travels along.
_ECHO: Final = frozenset({"udp_multicast"})

# Reasons of dropped()
_OVERFLOW: Final = "bus-pump-overflow"  # interface -> device: the relay did not keep up
_RECV_FAILED: Final = "bus-recv-failed"  # interface -> device: the driver could not make a message of it
_SEND_FAILED: Final = "bus-send-failed"  # device -> interface: the driver refused, or its queue stayed full

_log = logging.getLogger(__name__)


def open_python_can(interface: str, channel: str, options: Mapping[str, object]) -> PythonCanInterface:
    """Open `channel` of the python-can `interface`; `options` go to it as they are, as in its documentation.

    Like every program with python-can it also reads /etc/can.conf and ~/.canrc. Raises InterfaceError.
    """
    if interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise InterfaceError(
            f"python-can {can.__version__} knows no interface {interface!r}; it knows {known}"
        )
    if options.get("receive_own_messages"):
        raise InterfaceError(
            f"{interface}: receive_own_messages would send every frame back to where it came from"
        )
    if text := missing_package(interface):
        raise InterfaceError(text)
    arguments: dict[str, Any] = {**options, "receive_own_messages": False}
    try:
        bus = can.Bus(interface=interface, channel=channel or None, **arguments)
    except Exception as error:  # drivers raise far more than CanError
        _release_half_made(error)
        raise InterfaceError(f"{interface} {channel}: {error or type(error).__name__}") from error
    return PythonCanInterface(interface, channel, bus)


def _release_half_made(error: Exception) -> None:
    """A bus whose constructor failed is let go, or it keeps what it opened and complains at its end."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        bus = frame.f_locals.get("self")
        if isinstance(bus, can.BusABC):
            for shutdown in (bus.shutdown, lambda bus=bus: can.BusABC.shutdown(bus)):
                with contextlib.suppress(Exception):  # it lacks what its constructor did not come to
                    shutdown()
            return


class PythonCanInterface(Pump):
    """`struct can_frame` to a python-can bus, its messages back; CAN FD ones come as `struct canfd_frame`."""

    error = InterfaceError

    def __init__(self, interface: str, channel: str, bus: can.BusABC) -> None:
        super().__init__(f"{interface} {channel}".strip(), socket.SOCK_SEQPACKET)
        self.warning = ""
        self._bus = bus
        self._carries_error_frames = interface in _CARRY_ERROR_FRAMES
        self._sender = f"can-bridge {uuid.uuid4()}" if interface in _ECHO else None
        self._dropped = dict.fromkeys((_OVERFLOW, _RECV_FAILED, _SEND_FAILED, LOST_ERROR_FRAMES), 0)
        set_buffers(self._near)
        set_buffers(self._far)
        receive_stamped(self._near)
        self.start()

    def dropped(self) -> dict[str, int]:
        return {reason: count for reason, count in self._dropped.items() if count}

    def _inward(self) -> None:
        receive, forward, sender = self._bus.recv, self._far.send, self._sender
        failures = 0
        while not self._stopping.is_set():
            try:
                message = receive(POLL_INTERVAL_S)
            except Exception as error:  # ValueError for bad bytes, errors of USB libraries, ...
                failures += 1
                if failures == _RECV_FAILURES_MAX:
                    raise
                self._drop(_RECV_FAILED, error)
                self._stopping.wait(_RECV_PAUSE_S)
                continue
            failures = 0
            if message is None or not message.is_rx or (sender and message.channel == sender):
                continue
            try:
                forward(pack_message(message), socket.MSG_DONTWAIT)
            except BlockingIOError as error:
                self._drop(_OVERFLOW, error)

    def _outward(self) -> None:
        receive, send, sender = self._far.recv, self._bus.send, self._sender
        while packet := receive(_CANFD_FRAME.size):
            message = unpack_frame(packet)
            if message.is_error_frame and not self._carries_error_frames:
                self._dropped[LOST_ERROR_FRAMES] += 1  # by design, so not worth a log line
                continue
            if sender:
                message.channel = sender
            try:
                send(message, POLL_INTERVAL_S)
            except Exception as error:  # noqa: BLE001 - as above; a dead bus is noticed by the other thread
                self._drop(LOST_ERROR_FRAMES if message.is_error_frame else _SEND_FAILED, error)

    def _release(self) -> None:
        self._bus.shutdown()

    def _drop(self, reason: str, error: Exception | None = None) -> None:
        """Count, and log the 1st, 10th, 100th, ... Each reason is counted by one thread only."""
        count = self._dropped[reason] = self._dropped[reason] + 1
        if str(count).strip("0") == "1":
            _log.warning("dropped reason=%s bus=%s count=%d error=%s", reason, self.description, count, error)


def pack_message(message: can.Message) -> bytes:
    """A python-can message as `struct can_frame`, or as `struct canfd_frame` for CAN FD (linux/can.h)."""
    can_id = message.arbitration_id & _CAN_EFF_MASK
    if message.is_error_frame:
        can_id |= _CAN_ERR_FLAG
    elif message.is_extended_id:
        can_id |= _CAN_EFF_FLAG
    dlc = message.dlc
    if message.is_fd:
        flags = _CANFD_FDF
        if message.bitrate_switch:
            flags |= _CANFD_BRS
        if message.error_state_indicator:
            flags |= _CANFD_ESI
        return _CANFD_FRAME.pack(can_id, min(dlc, _CANFD_MAX_DLEN), flags, message.data)
    if message.is_remote_frame:
        return _CAN_FRAME.pack(can_id | _CAN_RTR_FLAG, min(dlc, _CAN_MAX_DLEN), 0, b"")
    if dlc > _CAN_MAX_DLEN:  # 9 to 15 mean 8 bytes in classic CAN (ISO 11898-1); len8_dlc keeps them
        return _CAN_FRAME.pack(can_id, _CAN_MAX_DLEN, dlc & 0x0F, message.data)
    return _CAN_FRAME.pack(can_id, dlc, 0, message.data)


def unpack_frame(frame: bytes) -> can.Message:
    """A `struct can_frame` as python-can message. A DLC above 8 is lost: most drivers refuse it."""
    can_id, length, _, data = _CAN_FRAME.unpack(frame)
    extended = bool(can_id & _CAN_EFF_FLAG)
    error = bool(can_id & _CAN_ERR_FLAG)
    remote = bool(can_id & _CAN_RTR_FLAG)
    return can.Message(
        arbitration_id=can_id & (_CAN_EFF_MASK if extended or error else _CAN_SFF_MASK),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=error,
        dlc=length,
        data=None if remote else data[:length],
    )
