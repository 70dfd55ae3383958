"""What /sys and /proc know about a device: its serial number, and which programs use it."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Final

from bridged.text import printable

_SYS: Final = Path("/sys")
_PROC: Final = Path("/proc")


def tty_directory(fd: int) -> Path | None:
    """The tty's directory, `…/1-1/1-1:1.0/ttyUSB0/tty/ttyUSB0`; None for what /sys has not, as a pty."""
    number = os.fstat(fd).st_rdev
    link = _SYS / "dev/char" / f"{os.major(number)}:{os.minor(number)}"
    return link.resolve() if link.exists() else None


def usb_directory(bus: int, ports: tuple[int, ...]) -> Path:
    """The directory of the USB device on these hub ports: bus 3, ports 1 and 4 -> `3-1.4`."""
    return _SYS / "bus/usb/devices" / f"{bus}-{'.'.join(map(str, ports))}"


def serial_number(directory: Path) -> str | None:
    """The serial number of the USB device that `directory` belongs to; None: it has none, or is not USB."""
    for parent in (directory, *directory.parents):
        if (parent / "idVendor").exists():  # the device itself; further up are hubs
            with contextlib.suppress(OSError):
                return printable((parent / "serial").read_text(errors="replace").strip()) or None
            return None
    return None


def latency_ms(tty: Path) -> int | None:
    """How long an FTDI chip waits for more bytes before it sends what it has; None if it is no such chip."""
    try:
        return int((tty / "device/latency_timer").read_text())
    except (OSError, ValueError):
        return None


def users(path: Path) -> list[str]:
    """Which processes have it open, as far as /proc lets us see: `slcand (process 123)`."""
    device = str(path.resolve())
    found = []
    for process in _PROC.glob("[0-9]*"):
        with contextlib.suppress(OSError):  # not ours, or just ended
            if any(str(link.readlink()) == device for link in (process / "fd").iterdir()):
                name = printable((process / "comm").read_text(errors="replace").strip())
                found.append(f"{name} (process {process.name})")
    return found
