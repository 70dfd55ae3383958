"""What /sys and /proc know about a device: its serial number, and which programs use it."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Final, NamedTuple

from bridged.text import printable

_SYS: Final = Path("/sys")
_PROC: Final = Path("/proc")


def tty_directory(fd: int) -> Path | None:
    """The tty's directory, `…/1-1/1-1:1.0/ttyUSB0/tty/ttyUSB0`; None for what /sys has not, as a pty."""
    number = os.fstat(fd).st_rdev
    link = _SYS / "dev/char" / f"{os.major(number)}:{os.minor(number)}"
    return link.resolve() if link.exists() else None


def has_tty(name: str) -> bool:
    """Whether the kernel has a tty of this name, `ttyUSB0`, with or without a node in /dev."""
    return (_SYS / "class/tty" / name).exists()


class UsbTty(NamedTuple):
    """A serial line of a USB device."""

    device: str  # where the device is plugged in: 3-1.4 is bus 3, ports 1 and 4
    interface: int  # which line of the device it is
    name: str  # ttyUSB0


def usb_ttys() -> dict[UsbTty, str]:
    """All that are there, with the serial number of their devices, which some do not have: ""."""
    found = {}
    for link in (_SYS / "class/tty").glob("tty[A-Z]*"):
        directory = link.resolve()
        device = usb_device(directory)
        if device is None:
            continue
        inner = directory.relative_to(device).parts[0]  # 1-1:1.0 is configuration 1, interface 0
        interface = inner.rpartition(".")[2]
        tty = UsbTty(device.name, int(interface) if interface.isdecimal() else 0, link.name)
        found[tty] = serial_number(device) or ""
    return dict(sorted(found.items()))


def usb_ttys_of(serial_number: str) -> list[UsbTty]:
    """Those of the devices with this serial number: one device after the other, its first line first."""
    return [tty for tty, number in usb_ttys().items() if number == serial_number]


def usb_directory(bus: int, ports: tuple[int, ...]) -> Path:
    """The directory of the USB device on these hub ports: bus 3, ports 1 and 4 -> `3-1.4`."""
    return _SYS / "bus/usb/devices" / f"{bus}-{'.'.join(map(str, ports))}"


def serial_number(directory: Path) -> str | None:
    """The serial number of the USB device that `directory` belongs to; None: it has none, or is not USB."""
    return _usb_text(directory, "serial")


def product(directory: Path) -> str | None:
    """What the USB device that `directory` belongs to calls itself; None: it does not, or is not USB."""
    return _usb_text(directory, "product")


def manufacturer(directory: Path) -> str | None:
    """Who made the USB device that `directory` belongs to, as it says; None: it does not, or is not USB."""
    return _usb_text(directory, "manufacturer")


def _usb_text(directory: Path, name: str) -> str | None:
    device = usb_device(directory)
    if device is not None:
        with contextlib.suppress(OSError):
            return printable((device / name).read_text(errors="replace").strip()) or None
    return None


def usb_device(directory: Path) -> Path | None:
    """The directory of the USB device that `directory` belongs to; further up are hubs."""
    return next((path for path in (directory, *directory.parents) if (path / "idVendor").exists()), None)


def latency_ms(tty: Path) -> int | None:
    """How long an FTDI chip waits for more bytes before it sends what it has; None if it is no such chip."""
    try:
        return int((tty / "device/latency_timer").read_text())
    except (OSError, ValueError):
        return None


def users(path: Path, *, others: bool = False) -> list[str]:
    """Which processes have it open, as far as we may see: `slcand (process 123)`, `bridge pc (process 4)`.

    Without the program that made the pseudo terminal: it is the other end of the line; with `others` also
    without this process.
    """
    device = str(path.resolve())
    own = str(os.getpid()) if others else None
    found = []
    for process in _PROC.glob("[0-9]*"):
        if process.name == own:
            continue
        files = _open_files(process)
        if device in files.values() and not _made_terminal(process, files, device):
            found.append(_described(process))
    return found


def _open_files(process: Path) -> dict[str, str]:
    """The file behind each descriptor; empty for a process of another user, or one that has just ended."""
    files = {}
    folder = f"{process}/fd"
    with contextlib.suppress(OSError):
        for fd in os.listdir(folder):  # noqa: PTH208 - as below: thousands of them
            with contextlib.suppress(OSError):
                files[fd] = os.readlink(f"{folder}/{fd}")  # noqa: PTH115
    return files


def _made_terminal(process: Path, files: dict[str, str], device: str) -> bool:
    """Whether one of a process's descriptors is the master of the pseudo terminal /dev/pts/N."""
    if "/pts/" not in device:
        return False
    index = f"tty-index:\t{device.rpartition('/')[2]}"
    masters = [fd for fd, target in files.items() if target.endswith("/ptmx")]
    with contextlib.suppress(OSError):
        return any(index in (process / "fdinfo" / fd).read_text().splitlines() for fd in masters)
    return False


def users_as_terminal(device: int) -> list[str]:
    """Whose controlling terminal the tty with this device number is; the leader of the session is first."""
    tty_nr = os.minor(device) & 0xFF | os.major(device) << 8 | (os.minor(device) & ~0xFF) << 12
    found = []
    for name in os.listdir(_PROC):  # noqa: PTH208 - each start of a bridge waits for it
        if not name.isdigit():
            continue
        with contextlib.suppress(OSError, ValueError):  # just ended
            fd = os.open(f"{_PROC}/{name}/stat", os.O_RDONLY | os.O_CLOEXEC)
            try:
                stat = os.read(fd, 1024)
            finally:
                os.close(fd)
            # proc_pid_stat(5): pid (comm) state ppid pgrp session tty_nr
            session, terminal = stat[stat.rindex(b")") + 2 :].split(b" ", 5)[3:5]
            if int(terminal) & 0xFFFFFFFF == tty_nr:
                found.append((session != name.encode(), int(name)))
    return [_described(_PROC / str(number)) for _, number in sorted(found)]


_WITHOUT_VALUE: Final = {"--verbose", "--mask", "--create", "--listen-only"}  # the usual options of `run`


def _described(process: Path) -> str:
    """`slcand (process 123)`; a bridge by its name, where its command line tells it."""
    try:
        command = (process / "comm").read_text(errors="replace").strip()
        words = (process / "cmdline").read_text(errors="replace").split("\0")
    except OSError:
        return f"process {process.name}"
    programs = {Path(word).name for word in words[:4]}
    if "run" in words and programs & {"can-bridge", "bridged"}:
        arguments = iter(words[words.index("run") + 1 :])
        for argument in arguments:
            if argument.startswith("--"):
                if "=" not in argument and argument not in _WITHOUT_VALUE:
                    next(arguments, None)
            elif argument:
                return f"bridge {printable(Path(argument).stem)} (process {process.name})"
    return f"{printable(command)} (process {process.name})"
