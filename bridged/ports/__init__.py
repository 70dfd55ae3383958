"""How bytes reach a device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from bridged.ports.names import PortName

if TYPE_CHECKING:
    from bridged.errors import BridgeError


class Port(Protocol):
    """An open byte stream to a device.

    `fd` is non-blocking: read() == 0 is a hang-up, EAGAIN is no data. It is -1 once closed.
    """

    fd: int
    description: str
    serial_number: str | None  # of the USB device that the port is; None: there is none, or it has none
    product: str | None  # what that USB device calls itself; None as above
    failure: BridgeError | None  # why `fd` came to its end, where the descriptor itself cannot tell

    def close(self) -> None:
        """Let the device go; what is not sent yet is lost. Idempotent, never waits for a dead device."""


def open_port(port: str, baudrate: int) -> Port:
    """Open a tty by its path or as `usb-serial://SERIAL`, a USB device by `usb://VID:PID[/SERIAL]`, or a URL.

    `baudrate` in bit/s; a USB FIFO has none. Raises PortError, with what to do about it.
    """
    name = PortName(port)
    if name.scheme == "usb":
        from bridged.ports.usb import open_usb  # noqa: PLC0415 - libusb only where a port needs it

        return open_usb(name)
    from bridged.ports.serial import open_serial  # noqa: PLC0415 - pyserial only where a port is opened

    return open_serial(name, baudrate)
