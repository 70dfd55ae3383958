"""What an open CAN interface of the host is, whichever kind it is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    from bridged.errors import BridgeError

LOST_ERROR_FRAMES: Final = "bus-error-frame"
"""The reason in OpenInterface.dropped() for error frames of ours: they are no frames of the adapter's."""


LOST_BEFORE_READ: Final = ("socket-overflow", "bus-pump-overflow", "bus-recv-failed")
"""Those for frames that were lost before the relay could read them."""


class OpenInterface(Protocol):
    """An open CAN interface of the host.

    `fd` is non-blocking and carries one `struct can_frame` (16 bytes) a datagram, or one `struct canfd_frame`
    (72 bytes) where the interface has CAN FD. Each datagram has a SO_TIMESTAMPNS control message. -1 once
    closed.
    """

    fd: int
    description: str
    warning: str  # what is wrong but need not stay so, for the log; empty when all is well
    failure: BridgeError | None  # why `fd` came to its end, where the descriptor itself cannot tell

    def dropped(self) -> dict[str, int]:
        """Frames lost between `fd` and the interface, by reason: the relay cannot see them."""

    def close(self) -> None:
        """Let the interface go. Idempotent."""
