"""Device events of the kernel and of udev: what was plugged in."""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
from typing import Final

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


def open_socket() -> socket.socket | None:
    """The kernel's socket of device events, non-blocking; None where there is none (no AF_NETLINK)."""
    with contextlib.suppress(OSError):
        events = socket.socket(
            socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_NONBLOCK, _NETLINK_KOBJECT_UEVENT
        )
        events.bind((0, 0))  # or the kernel would take us for itself, and not tell us
        return events
    return None


class Uevents:
    """The events on such a socket: it gets them while it listens."""

    def __init__(self, events: socket.socket) -> None:
        self._socket = events

    def fileno(self) -> int:
        """Readable when there is something to read."""
        return self._socket.fileno()

    def listen(self, on: bool) -> None:
        for group in _GROUPS:
            with contextlib.suppress(OSError):
                self._socket.setsockopt(_SOL_NETLINK, _ADD_MEMBERSHIP if on else _DROP_MEMBERSHIP, group)

    def read(self) -> tuple[list[dict[str, str]], bool]:
        """The properties of all events that wait, and whether the kernel had to throw some away."""
        events, some_lost = [], False
        while True:
            try:
                events.append(_properties(self._socket.recv(_EVENT_SIZE)))
            except OSError as error:
                if error.errno not in {errno.ENOBUFS, errno.EINTR}:  # EAGAIN: that was all
                    return events, some_lost
                some_lost = some_lost or error.errno == errno.ENOBUFS

    def close(self) -> None:
        self._socket.close()


def _properties(event: bytes) -> dict[str, str]:
    """`add@/devices/…\\0ACTION=add\\0SUBSYSTEM=tty\\0…`; udev's has a binary header instead of the first."""
    start = 0
    if event.startswith(_UDEV_PREFIX) and len(event) >= _UDEV_OFFSET.size:
        (start,) = _UDEV_OFFSET.unpack_from(event)
    pairs = (line.partition("=") for line in event[start:].decode(errors="replace").split("\0"))
    return {key: value for key, equals, value in pairs if equals}
