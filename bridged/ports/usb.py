"""FTDI FIFO chips (FT245, FT240) raw through libusb: `usb://0403:6001/A6001234`, without a tty.

Such a chip has no UART, so no baud rate; one that has (FT232) belongs on its tty.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import usb.backend.libusb1
import usb.core
import usb.util
from usb.core import USBError, USBTimeoutError

from bridged.errors import NotPermittedError, PortError
from bridged.ports import sysfs
from bridged.ports.permission import explain_forbidden, explain_refused_usb
from bridged.ports.pump import POLL_INTERVAL_S, Pump
from bridged.text import printable

if TYPE_CHECKING:
    from array import array

    from bridged.ports.names import PortName

_DEV: Final = Path("/dev")
_LIBUSB: Final = "libusb-1.0.so.0"

_POLL_INTERVAL_MS: Final = round(POLL_INTERVAL_S * 1000)
_BLOCK: Final = 4096
# What waits between the relay and the chip grows old: room for some twenty small writes.
_SEND_BUFFER: Final = 8192

# FTDI's requests, as in the kernel's ftdi_sio.h; wIndex is 0, there is one channel only.
_VENDOR_OUT: Final = 0x40
_RESET: Final = 0
_RESET_SIO: Final = 0
_PURGE_RX: Final = 1
_PURGE_TX: Final = 2
_SET_LATENCY_TIMER: Final = 9
_LATENCY_MS: Final = 1

_STATUS_BYTES: Final = 2  # modem and line status, in front of each packet
_PACKETS: Final = 64  # in one transfer at most


def open_usb(name: PortName) -> UsbPort:
    """Open `usb://VID:PID[/SERIAL]`, VID and PID hexadecimal as lsusb shows them. Raises PortError."""
    url = name.text
    if name.usb_id is None:
        raise PortError(f"{url}: not of the form usb://VID:PID or usb://VID:PID/SERIAL, as usb://0403:6001")
    vendor, product = name.usb_id
    backend = _load_libusb(url)
    try:
        alike = list(usb.core.find(find_all=True, backend=backend, idVendor=vendor, idProduct=product))
    except USBError as error:
        raise PortError(f"{url}: cannot list USB devices: {error}") from error
    device, serial_number = _choose(url, alike, name.serial_number)
    try:
        chip = _Chip(url, device)
    except USBError as error:
        kind = NotPermittedError if error.errno == errno.EACCES else PortError
        raise kind(f"{url}: {_explain(device, error)}") from error
    return UsbPort(url, chip, serial_number)


class UsbPort(Pump):
    """The bytes of an FTDI FIFO chip."""

    error = PortError

    def __init__(self, url: str, chip: _Chip, serial_number: str | None) -> None:
        super().__init__(url, socket.SOCK_STREAM)
        self.serial_number = serial_number
        self.product: str | None = None  # only FTDI's chips get so far
        self._chip = chip
        self._near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self.start()

    def _inward(self) -> None:
        buffer = usb.util.create_buffer(_PACKETS * self._chip.packet_size)
        view = memoryview(buffer)
        while not self._stopping.is_set():
            try:
                n = self._chip.read(buffer)
            except USBError as error:
                raise PortError(_why_lost(error)) from error
            if n > _STATUS_BYTES and (data := strip_status(view[:n], self._chip.packet_size)):
                self._far.sendall(data)

    def _outward(self) -> None:
        while data := self._far.recv(_BLOCK):
            while data:
                try:
                    n = self._chip.write(data)
                except USBError as error:
                    raise PortError(_why_lost(error)) from error
                data = data[n:]
                if data and self._stopping.is_set():  # what the chip takes at once still goes out
                    return

    def _release(self) -> None:
        self._chip.close()


class _Chip:
    """An FTDI chip that is ours: taken from the kernel's driver, and given back to it by close()."""

    def __init__(self, url: str, device: Any) -> None:
        self._url = url
        self._device = device
        self._interface = 0
        self._taken = False
        try:
            self._claim()
            self._prepare()
        except BaseException:
            self.close()
            raise

    def _claim(self) -> None:
        interface = self._configuration()[(0, 0)]
        self._interface = interface.bInterfaceNumber
        ends = {usb.util.endpoint_direction(end.bEndpointAddress): end for end in interface}
        if ends.keys() != {usb.util.ENDPOINT_IN, usb.util.ENDPOINT_OUT}:
            raise PortError(f"{self._url}: not an FTDI chip, it has other endpoints")
        self._in = ends[usb.util.ENDPOINT_IN].bEndpointAddress
        self._out = ends[usb.util.ENDPOINT_OUT].bEndpointAddress
        self.packet_size = int(ends[usb.util.ENDPOINT_IN].wMaxPacketSize)
        if self._device.is_kernel_driver_active(self._interface):
            self._refuse_if_used()
            self._device.detach_kernel_driver(self._interface)
            self._taken = True
        usb.util.claim_interface(self._device, self._interface)

    def _refuse_if_used(self) -> None:
        """Never take a tty away from a program that has it open."""
        directory = sysfs.usb_directory(self._device.bus, self._device.port_numbers or ())
        for tty in directory.glob(f"*:*.{self._interface}/tty*"):
            if users := sysfs.users(_DEV / tty.name):
                raise PortError(
                    f"{self._url}: {_DEV / tty.name} is in use by {', '.join(users)}: stop that first"
                )

    def _configuration(self) -> Any:
        """The active configuration. Setting it anew would reset the device, so only where there is none."""
        try:
            return self._device.get_active_configuration()
        except USBError as error:
            if error.errno is not None:  # pyusb's own "Configuration not set" has none
                raise
        self._device.set_configuration()
        return self._device.get_active_configuration()

    def _prepare(self) -> None:
        for value in (_RESET_SIO, _PURGE_RX, _PURGE_TX):
            try:
                self._device.ctrl_transfer(_VENDOR_OUT, _RESET, value)
            except USBError as error:
                if error.errno == errno.EPIPE:
                    raise PortError(f"{self._url}: not an FTDI chip, it refused a reset") from error
                raise
        try:
            self._device.ctrl_transfer(_VENDOR_OUT, _SET_LATENCY_TIMER, _LATENCY_MS)
        except USBError as error:
            if error.errno != errno.EPIPE:  # an FT8U245AM has no such timer
                raise

    def read(self, buffer: array[int]) -> int:
        """Read packets as they are; 0 if there is none within POLL_INTERVAL_S. Raises USBError."""
        try:
            return int(self._device.read(self._in, buffer, _POLL_INTERVAL_MS))
        except USBTimeoutError:
            return 0

    def write(self, data: bytes) -> int:
        """Write; how many bytes the chip took within POLL_INTERVAL_S. Raises USBError."""
        try:
            return int(self._device.write(self._out, data, _POLL_INTERVAL_MS))
        except USBTimeoutError:
            return 0

    def close(self) -> None:
        """Let it go, as far as it is still there."""
        with contextlib.suppress(USBError):
            usb.util.release_interface(self._device, self._interface)
        if self._taken:
            with contextlib.suppress(USBError):
                self._device.attach_kernel_driver(self._interface)
        usb.util.dispose_resources(self._device)


def strip_status(transfer: memoryview, packet_size: int) -> bytes:
    """Drop the two status bytes of each packet: 01 60 'A' 'B' -> 'A' 'B'; all packets but the last are full.

    As the kernel's ftdi_process_read_urb() has it.
    """
    if len(transfer) <= packet_size:
        return bytes(transfer[_STATUS_BYTES:])
    packets = range(0, len(transfer), packet_size)
    return b"".join([transfer[at + _STATUS_BYTES : at + packet_size] for at in packets])


def _load_libusb(url: str) -> Any:
    # By its name: pyusb would start ldconfig and gcc to find it.
    backend = usb.backend.libusb1.get_backend(find_library=lambda _: _LIBUSB)
    if backend is not None:
        return backend
    try:
        ctypes.CDLL(_LIBUSB)
    except OSError as error:
        raise PortError(f"{url}: libusb-1.0 is missing: `apt install libusb-1.0-0`") from error
    if not (_DEV / "bus/usb").exists():
        raise PortError(f"{url}: this machine has no USB, there is no {_DEV / 'bus/usb'}")
    raise PortError(
        f"{url}: libusb cannot start: allow AF_NETLINK in RestrictAddressFamilies= of the service"
    )


def _choose(url: str, alike: list[Any], wanted: str | None) -> tuple[Any, str | None]:
    """The one device that is meant, and its serial number."""
    if not alike:
        raise PortError(f"{url}: no such USB device, is it plugged in?")
    numbers = [_serial_number(device) for device in alike]
    names = ", ".join(sorted(number or "one without serial number" for number in numbers))
    matching = [n for n, number in enumerate(numbers) if wanted in {None, number}]
    if not matching:
        raise PortError(f"{url}: no such USB device: there is {names}")
    if len(matching) > 1:
        first = next(filter(None, numbers), None)
        if wanted or first is None:
            raise PortError(f"{url}: {len(matching)} devices alike cannot be told apart: plug in only one")
        raise PortError(f"{url}: {len(matching)} of them: add a serial number ({names}), as {url}/{first}")
    return alike[matching[0]], numbers[matching[0]]


def _serial_number(device: Any) -> str | None:
    """By way of /sys, which tells it to everybody and bothers no device; else from the device itself."""
    if device.bus is not None and device.port_numbers:
        directory = sysfs.usb_directory(device.bus, device.port_numbers)
        if directory.exists():
            return sysfs.serial_number(directory)
    try:
        number = device.serial_number
    except (USBError, ValueError):  # no permission, or just unplugged
        return None
    finally:
        usb.util.dispose_resources(device)
    return printable(str(number)) if number else None


def _node(device: Any) -> Path:
    return _DEV / "bus/usb" / f"{device.bus:03}" / f"{device.address:03}"


def _explain(device: Any, error: USBError) -> str:
    """What is wrong and what to do."""
    node = _node(device)
    match error.errno:
        case errno.EACCES:
            return explain_refused_usb(node, device.idVendor, device.idProduct)
        case errno.EBUSY:
            ourselves = f"(process {os.getpid()})"
            users = [user for user in sysfs.users(node) if not user.endswith(ourselves)]
            return (
                f"in use by {', '.join(users) or 'another program, another bridge perhaps'}: stop that first"
            )
        case errno.ENODEV | errno.ENOENT:
            return f"it was just unplugged ({error.strerror})"
        case errno.EIO if not os.access(node, os.R_OK | os.W_OK):  # libusb's name for EPERM
            return explain_forbidden(node)
        case _:
            return f"cannot be opened: {error.strerror}"


def _why_lost(error: USBError) -> str:
    if error.errno in {errno.ENODEV, errno.ENOENT}:
        return f"unplugged ({error.strerror})"
    if error.errno in {errno.EIO, errno.EPROTO}:
        return f"unplugged, or its cable is bad ({error.strerror})"
    return f"USB error: {error.strerror}"
