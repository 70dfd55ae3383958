"""How bytes reach a device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from bridged.errors import BridgeError


class Port(Protocol):
    """An open byte stream to a device.

    `fd` is non-blocking: read() == 0 is a hang-up, EAGAIN is no data. It is -1 once closed.
    """

    fd: int
    description: str
    failure: BridgeError | None  # why `fd` came to its end, where the descriptor itself cannot tell

    def close(self) -> None:
        """Let the device go; what is not sent yet is lost. Idempotent, never waits for a dead device."""


def open_port(port: str, baudrate: int) -> Port:
    """Open a tty by its path or a pyserial URL, `baudrate` in bit/s.

    Raises PortError, with what to do about it.
    """
    from bridged.ports.serial import open_serial  # noqa: PLC0415 - pyserial only where a port is opened

    return open_serial(port, baudrate)
