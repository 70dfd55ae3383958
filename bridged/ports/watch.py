"""Tells when the device of a port is plugged in: by device events, and by names that appear in /dev.

Each finds what the other does not: udev's events tell of permissions and links, but a container with a user
namespace gets no events at all; and a path need not be one of the kernel's devices.
"""

from __future__ import annotations

import contextlib
import os
import select
import stat
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bridged.errors import PortError
from bridged.ports import sysfs
from bridged.ports.names import PortName
from bridged.ports.uevents import Uevents, open_socket

if TYPE_CHECKING:
    import socket
    from collections.abc import Iterator

    from bridged.ports.inotify import Inotify

_SYS: Final = Path("/sys")
_DEV: Final = Path("/dev")

_LINKS_MAX: Final = 40  # as the kernel follows


class Watch:
    """Looks out for the device of a port: a path, `usb-serial://SERIAL`, `usb://VID:PID[/SERIAL]`.

    A URL of the network has none. `fd` is readable when something happens between arm() and disarm(); it is
    -1 where nothing will tell: then only is_there() does.
    """

    def __init__(
        self, port: str, usb_serial_number: str | None = None, events: socket.socket | None = None
    ) -> None:
        """With `usb_serial_number`, a tty may have another path than `port`: it is known by that number.

        `events` is non-blocking and stands for the kernel's socket of device events.
        """
        self._port = port
        self._name = PortName(port)
        self._serial_number: str | None = None  # of the USB device whose tty is meant
        if self._name.path:
            self._serial_number = usb_serial_number
        elif self._name.is_tty_of_usb_device:
            self._serial_number = self._name.serial_number
        self._terminal: tuple[int, int] | None = None  # the numbered one that was opened
        self._uevents: Uevents | None = None
        self._inotify: Inotify | None = None  # between arm() and disarm()
        self._epoll: select.epoll | None = None
        if self._name.path or self._name.usb_id or self._name.is_tty_of_usb_device:
            with contextlib.suppress(OSError):  # no descriptor is left
                self._epoll = select.epoll()
        if self._epoll and (events := events or open_socket()):
            self._uevents = Uevents(events)
            self._epoll.register(events, select.EPOLLIN)
        self.fd = self._epoll.fileno() if self._epoll else -1

    def arm(self) -> None:
        """Before a look: what comes between the two would be missed else."""
        if self._uevents:
            self._uevents.listen(True)
        if self._epoll and self._inotify is None:
            with contextlib.suppress(OSError):  # other programs of this user have too many of them
                from bridged.ports.inotify import Inotify  # noqa: PLC0415 - it takes ctypes

                self._inotify = Inotify()
                self._epoll.register(self._inotify, select.EPOLLIN)
        self._look_into_directories()

    def disarm(self) -> None:
        if self._inotify:
            self._inotify.close()
            self._inotify = None
        if self._uevents:
            self._uevents.listen(False)
            self._uevents.read()

    def close(self) -> None:
        """Idempotent."""
        self.fd = -1
        for part in (self._inotify, self._uevents, self._epoll):
            if part:
                part.close()
        self._inotify = self._uevents = self._epoll = None

    def has_come(self) -> bool:
        """Read all events; whether our device was plugged in, or may have been."""
        events, some_lost = self._uevents.read() if self._uevents else ([], False)
        paths, others = self._inotify.read() if self._inotify else (set(), False)
        if paths or others:
            self._look_into_directories()
        perhaps = some_lost or others or any(self._is_ours(event) for event in events)
        return (perhaps or not paths.isdisjoint(self._steps())) and self.is_there()

    def is_there(self) -> bool:
        """Whether there is something to open. True where one cannot know."""
        if self._name.usb_id:
            return not (_SYS / "bus/usb/devices").exists() or any(self._usb_devices())
        if self._name.is_tty_of_usb_device:
            return bool(self._ttys())
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
        ttys = self._ttys()
        if not ttys or Path(self._port).resolve().name in {tty.name for tty in ttys}:
            return self._port
        if self._name.is_tty_of_usb_device and len({tty.device for tty in ttys}) > 1:
            return self._port  # opening it says that one cannot know which is meant
        return str(_DEV / ttys[0].name)

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

    def _ttys(self) -> list[sysfs.UsbTty]:
        """The ttys of the USB device with the serial number; none if it does not matter."""
        return sysfs.usb_ttys_of(self._serial_number) if self._serial_number else []

    def _usb_devices(self) -> Iterator[Path]:
        """The directories of those that usb://VID:PID/SERIAL may mean."""
        assert self._name.usb_id
        wanted = tuple(f"{number:04x}" for number in self._name.usb_id)
        for device in (_SYS / "bus/usb/devices").glob("*"):
            with contextlib.suppress(OSError):  # an interface, or just unplugged
                if (_read(device / "idVendor"), _read(device / "idProduct")) != wanted:
                    continue
                if self._name.serial_number in {None, sysfs.serial_number(device)}:
                    yield device

    # --- directories --------------------------------------------------------------------------

    def _look_into_directories(self) -> None:
        """Has inotify tell of what may lead to the device, as far as it exists; more does with each step."""
        while self._inotify and self._inotify.add(self._directories()):
            pass  # something may have come in there before: look again

    def _directories(self) -> set[Path]:
        """Where the next step to the device may appear."""
        found = {Path(step).parent for step in self._steps() if not _is_directory(step)}
        if self._serial_number:
            found.add(_DEV)
        if self._name.usb_id:
            found |= {_DEV / "bus/usb", *(_DEV / "bus/usb").glob("[0-9]*")}
        return found

    def _steps(self) -> set[str]:
        """All names that are looked up on the way to what would be opened."""
        if not self._name.usb_id:
            return set() if self._name.scheme and self.path() == self._port else set(_steps_to(self.path()))
        steps = set(_steps_to(_DEV / "bus/usb"))
        for device in self._usb_devices():
            with contextlib.suppress(OSError, ValueError):  # just unplugged
                bus, address = int(_read(device / "busnum")), int(_read(device / "devnum"))
                steps.update(_steps_to(_DEV / f"bus/usb/{bus:03}/{address:03}"))
        return steps


def _steps_to(path: str | Path) -> Iterator[str]:
    """The names that the kernel looks up to open `path`, links followed: /dev, …, /dev/ttyUSB0."""
    here = "/"
    parts = deque(Path(path).parts[1:])
    links = 0
    while parts and links <= _LINKS_MAX:
        name = parts.popleft()
        if name == "..":
            here = os.path.dirname(here)  # noqa: PTH120 - a text, as inotify's
            continue
        step = os.path.join(here, name)  # noqa: PTH118
        yield step
        try:
            target = Path(step).readlink()
        except OSError:  # no link, or nothing at all
            here = step
            continue
        links += 1
        if target.is_absolute():
            here = "/"
        parts.extendleft(reversed(target.parts[1:] if target.is_absolute() else target.parts))


def _is_directory(path: str) -> bool:
    """Itself, and no link to one."""
    try:
        return stat.S_ISDIR(os.lstat(path).st_mode)
    except OSError:
        return False


def _identity(terminal: os.stat_result) -> tuple[int, int]:
    """Differs between two pseudo terminals of one number: the kernel makes the inode with each."""
    return terminal.st_rdev, terminal.st_ctime_ns


def _read(file: Path) -> str:
    return file.read_text().strip()
