"""Which serial ports and USB devices this machine has, as /sys says: none of them is opened.

To open a terminal may reset the device behind it, or change the rate of somebody who uses it.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from bridged.ports import permission, sysfs
from bridged.ports.names import PortName

if TYPE_CHECKING:
    from collections.abc import Iterator

_SYS: Final = Path("/sys")
_DEV: Final = Path("/dev")

_FTDI: Final = 0x0403  # whose chips can be had without a tty
_HUB: Final = "09"  # bDeviceClass
_NO_CHIP: Final = "0"  # a ttyS that has a name only
_SERIAL_CORE: Final = {"port", "ctrl"}  # drivers of no device: serial_base, in Linux 6.5 and newer


class UsbDevice(NamedTuple):
    """What a USB device says of itself."""

    id: tuple[int, int]  # vendor, product
    manufacturer: str | None
    product: str | None
    serial_number: str | None


class Device(NamedTuple):
    """A serial port, or a USB device that has none."""

    port: str  # the name for a configuration, one that stays if there is one; "": it cannot be a port
    node: Path  # in /dev
    driver: str | None
    usb: UsbDevice | None

    @property
    def is_tty(self) -> bool:
        """Whether it is a serial port."""
        return self.node.name.startswith("tty")

    def is_meant_by(self, port: str) -> bool:
        """Whether the port of a configuration is this device."""
        name = PortName(port)
        if name.path:
            return Path(name.path).resolve() == self.node
        if self.usb is None or name.scheme not in {"usb", "usb-serial"}:
            return False
        known = {None, self.usb.serial_number} if name.usb_id else {self.usb.serial_number}
        return name.usb_id in {None, self.usb.id} and name.serial_number in known

    def refusal(self) -> str:
        """Why this process may not open it, and what to do; empty: as far as its mode says it may."""
        if not self.node.exists():
            return f"there is no {self.node} here: a container gets it by --volume /dev:/dev"
        if os.access(self.node, os.R_OK | os.W_OK, effective_ids=True):
            return ""
        if self.port.startswith("usb://") and self.usb:
            return permission.explain_refused_usb(self.node, *self.usb.id)
        return permission.explain_refused(self.node)


def devices() -> list[Device]:
    """All serial ports with something behind them, then all USB devices that have none (but for hubs)."""
    ttys = [*_ttys()]
    with_tty = {usb for _, usb in ttys}
    numbers = [sysfs.serial_number(usb) for usb in with_tty if usb]
    return [*(_serial_port(tty, usb, numbers) for tty, usb in ttys), *_without_tty(with_tty)]


def _ttys() -> Iterator[tuple[Path, Path | None]]:
    """The directory of each tty, and that of its USB device if it has one."""
    for link in sorted((_SYS / "class/tty").glob("tty[A-Z]*"), key=lambda link: (len(link.name), link.name)):
        if (link / "device").exists() and _read(link / "type") != _NO_CHIP:
            directory = link.resolve()
            yield directory, sysfs.usb_device(directory)


def _serial_port(tty: Path, usb: Path | None, numbers: list[str | None]) -> Device:
    node = _DEV / tty.name
    port = _by_serial_number(tty, numbers) or next(map(str, _links(node)), str(node))
    return Device(port, node, _driver(tty / "device"), _identity(usb) if usb else None)


def _by_serial_number(tty: Path, numbers: list[str | None]) -> str | None:
    """usb-serial://SERIAL, if that means this tty; `numbers`: those of all USB devices with ttys."""
    number = sysfs.serial_number(tty)
    if number is None or numbers.count(number) != 1 or sysfs.usb_ttys_of(number)[0].name != tty.name:
        return None
    url = f"usb-serial://{number}"
    return url if PortName(url).problem() is None else None  # one with spaces


def _links(node: Path) -> Iterator[Path]:
    """The names of udev that stay: of the device, else of the place where it is plugged in."""
    for folder in ("by-id", "by-path"):
        for link in sorted((_DEV / "serial" / folder).glob("*")):
            if link.resolve() == node:
                yield link


def _driver(device: Path) -> str | None:
    """Of a tty's device, or of the one above where the kernel's serial core is between them."""
    directory = device.resolve()
    for path in (directory, *directory.parents[:2]):
        driver = path / "driver"
        if driver.exists() and (name := driver.resolve().name) not in _SERIAL_CORE:
            return name
    return None


def _without_tty(with_tty: set[Path | None]) -> Iterator[Device]:
    for link in sorted((_SYS / "bus/usb/devices").glob("*")):
        directory = link.resolve()
        usb = _identity(directory)
        if usb is None or directory in with_tty or _read(directory / "bDeviceClass") == _HUB:
            continue
        drivers = (interface / "driver" for interface in sorted(directory.glob(f"{directory.name}:*")))
        driver = next((driver.resolve().name for driver in drivers if driver.exists()), None)
        with contextlib.suppress(ValueError):  # it was just unplugged
            bus, number = int(_read(directory / "busnum")), int(_read(directory / "devnum"))
            node = _DEV / "bus/usb" / f"{bus:03}" / f"{number:03}"
            yield Device(_url(usb) if usb.id[0] == _FTDI else "", node, driver, usb)


def _url(usb: UsbDevice) -> str:
    url = f"usb://{usb.id[0]:04x}:{usb.id[1]:04x}"
    whole = f"{url}/{usb.serial_number}"
    return whole if usb.serial_number and PortName(whole).problem() is None else url


def _identity(directory: Path) -> UsbDevice | None:
    try:
        ids = int(_read(directory / "idVendor"), 16), int(_read(directory / "idProduct"), 16)
    except ValueError:  # one of its interfaces, or just unplugged
        return None
    return UsbDevice(
        ids, sysfs.manufacturer(directory), sysfs.product(directory), sysfs.serial_number(directory)
    )


def _read(file: Path) -> str:
    try:
        return file.read_text().strip()
    except OSError:
        return ""
