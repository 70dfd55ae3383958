"""Where frames go on the host."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bridged.errors import BridgeError

LOST_ERROR_FRAMES: Final = "bus-error-frame"
"""The reason in Bus.dropped() for error frames of ours: they are no frames of the adapter's."""


class Bus(Protocol):
    """An open CAN interface of the host.

    `fd` is non-blocking and carries one `struct can_frame` (16 bytes) a datagram, or one `struct canfd_frame`
    (72 bytes) where the bus has CAN FD. Each datagram has a SO_TIMESTAMPNS control message. -1 once closed.
    """

    fd: int
    description: str
    warning: str  # what is wrong but need not stay so, for the log; empty when all is well
    failure: BridgeError | None  # why `fd` came to its end, where the descriptor itself cannot tell

    def dropped(self) -> dict[str, int]:
        """Frames lost between `fd` and the bus, by reason: the relay cannot see them."""

    def close(self) -> None:
        """Let the bus go. Idempotent."""


def open_bus(interface: str, channel: str, *, create: bool, options: Mapping[str, object]) -> Bus:
    """Open `channel` of a python-can interface name; `socketcan` is the kernel's own and needs no python-can.

    `create` is for socketcan alone, `options` for the others. Raises BusError, with what to do about it.
    """
    if interface == "socketcan":
        from bridged.buses.socketcan import open_socketcan  # noqa: PLC0415 - only the kind that is used

        return open_socketcan(channel, create)
    from bridged.buses.python_can import open_python_can  # noqa: PLC0415 - python-can costs 85 ms and 19 MB

    return open_python_can(interface, channel, options)
