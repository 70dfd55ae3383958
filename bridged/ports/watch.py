"""Tells when the device of a port is plugged in: by the device events of the kernel and of udev."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
import struct
from pathlib import Path
from typing import Final

from bridged.errors import PortError
from bridged.ports import sysfs
from bridged.ports.names import PortName

_SYS: Final = Path("/sys")
_DEV: Final = Path("/dev")

# linux/netlink.h, not in Python's socket module
_NETLINK_KOBJECT_UEVENT: Final = 15
_SOL_NETLINK: Final = 270
_ADD_MEMBERSHIP: Final = 1
_DROP_MEMBERSHIP: Final = 2
# The kernel's own events, and udev's, which come when its rules have set permissions and links.
_GROUPS: Final = (1, 2)

_UDEV_PREFIX: Final = b"libudev\0"
_UDEV_OFFSET: Final = struct.Struct("=16xI")  # where the properties begin (systemd, device-monitor.c)
_EVENT_SIZE: Final = 16_384


class Watch:
    """Looks out for the device of a port: a path, `usb://VID:PID[/SERIAL]`, or a URL that has none.

    `fd` is readable at device events between arm() and disarm(); it is -1 where there are none (a sandbox
    without AF_NETLINK): then only is_there() tells.
    """

    def __init__(
        self, port: str, usb_serial_number: str | None = None, events: socket.socket | None = None
    ) -> None:
        """With `usb_serial_number`, a tty may have another path than `port`: it is known by that number.

        `events` is non-blocking and stands for the kernel's socket of device events.
        """
        self._port = port
        self._name = PortName(port)
        self._usb_serial_number = usb_serial_number
        self._terminal: tuple[int, int] | None = None  # the numbered one that was opened
        self._socket = events
        if events is None and (self._name.usb_id or self._name.path):
            with contextlib.suppress(OSError):
                self._socket = socket.socket(
                    socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_NONBLOCK, _NETLINK_KOBJECT_UEVENT
                )
                self._socket.bind((0, 0))  # or the kernel would take us for itself, and not tell us
        self.fd = self._socket.fileno() if self._socket else -1

    def arm(self) -> None:
        self._set_membership(_ADD_MEMBERSHIP)

    def disarm(self) -> None:
        self._set_membership(_DROP_MEMBERSHIP)
        self._read_events()

    def close(self) -> None:
        """Idempotent."""
        self.fd = -1
        if self._socket:
            self._socket.close()
            self._socket = None

    def has_come(self) -> bool:
        """Read all events; whether our device was plugged in, or may have been."""
        events, some_lost = self._read_events()
        return (some_lost or any(self._is_ours(event) for event in events)) and self.is_there()

    def is_there(self) -> bool:
        """Whether there is something to open. True where one cannot know."""
        if self._name.usb_id:
            return self._has_usb_device(*self._name.usb_id)
        if not self._name.path:
            return True
        if self._is_stranger():
            return False
        try:
            os.stat(self.path())  # noqa: PTH116 - exists() does not tell why not
        except PermissionError:  # opening says so
            return True
        except OSError:
            return False
        return True

    def path(self) -> str:
        """What to open: the port, or the tty that has the serial number if what the port means has not."""
        if self._usb_serial_number is None or not self._name.path:
            return self._port
        ttys = [
            tty.name
            for tty in sorted((_SYS / "class/tty").glob("tty[A-Z]*"))
            if sysfs.serial_number(tty.resolve()) == self._usb_serial_number
        ]
        if not ttys or Path(self._port).resolve().name in ttys:
            return self._port
        return str(_DEV / ttys[0])

    def opened(self, fd: int) -> None:
        """The port was opened as `fd`: a numbered terminal is known by it from now on."""
        if self._name.is_numbered_terminal and self._terminal is None:
            status = os.fstat(fd)
            if not stat.S_ISCHR(status.st_mode):  # something is between the terminal and its user
                status = os.stat(self._port)  # noqa: PTH116 - as above
            self._terminal = _identity(status)

    def refuse_stranger(self) -> None:
        """PortError if /dev/pts/N is not the terminal any more that was opened first.

        The kernel gives the number of one that has ended to the next that is made: somebody's shell.
        """
        if self._is_stranger():
            raise PortError(
                f"{self._port}: this terminal has ended; the next one with its number may be anybody's and "
                "is not taken: use a name that stays, as of simulate --link PATH, or start the bridge again"
            )

    def _is_stranger(self) -> bool:
        if self._terminal is None:
            return False
        try:
            return _identity(os.stat(self._port)) != self._terminal  # noqa: PTH116 - as above
        except OSError:
            return True

    def _is_ours(self, event: dict[str, str]) -> bool:
        if event.get("ACTION") != "add":
            return False
        if self._name.usb_id:
            vendor, product = self._name.usb_id
            wanted = f"{vendor:x}/{product:x}/"  # PRODUCT=403/6001/600, the last is the version
            return event.get("DEVTYPE") == "usb_device" and event.get("PRODUCT", "").startswith(wanted)
        name = Path(event.get("DEVNAME", "")).name  # ttyUSB0 from the kernel, /dev/ttyUSB0 from udev
        return event.get("SUBSYSTEM") == "tty" and name == Path(self.path()).resolve().name

    def _has_usb_device(self, vendor: int, product: int) -> bool:
        devices = _SYS / "bus/usb/devices"
        if not devices.exists():
            return True
        wanted = (f"{vendor:04x}", f"{product:04x}")
        for device in devices.iterdir():
            with contextlib.suppress(OSError):  # an interface, or just unplugged
                if (_read(device / "idVendor"), _read(device / "idProduct")) != wanted:
                    continue
                if self._name.serial_number in {None, sysfs.serial_number(device)}:
                    return True
        return False

    def _set_membership(self, option: int) -> None:
        if self._socket:
            for group in _GROUPS:
                with contextlib.suppress(OSError):
                    self._socket.setsockopt(_SOL_NETLINK, option, group)

    def _read_events(self) -> tuple[list[dict[str, str]], bool]:
        """All that wait, and whether the kernel had to throw some away."""
        events, some_lost = [], False
        while self._socket:
            try:
                events.append(_properties(self._socket.recv(_EVENT_SIZE)))
            except OSError as error:
                if error.errno not in {errno.ENOBUFS, errno.EINTR}:  # EAGAIN: that was all
                    break
                some_lost = some_lost or error.errno == errno.ENOBUFS
        return events, some_lost


def _identity(terminal: os.stat_result) -> tuple[int, int]:
    """Differs between two pseudo terminals of one number: the kernel makes the inode with each."""
    return terminal.st_rdev, terminal.st_ctime_ns


def _read(file: Path) -> str:
    return file.read_text().strip()


def _properties(event: bytes) -> dict[str, str]:
    """`add@/devices/…\\0ACTION=add\\0SUBSYSTEM=tty\\0…`; udev's has a binary header instead of the first."""
    start = 0
    if event.startswith(_UDEV_PREFIX) and len(event) >= _UDEV_OFFSET.size:
        (start,) = _UDEV_OFFSET.unpack_from(event)
    pairs = (line.partition("=") for line in event[start:].decode(errors="replace").split("\0"))
    return {key: value for key, equals, value in pairs if equals}
