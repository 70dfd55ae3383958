"""A /dev and a /sys without anything in it, where USB serial adapters are plugged in and pulled out."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import pytest

from bridged.ports import serial, sysfs, watch
from bridged.ports.watch import Watch


def kernel_event(**properties: str) -> bytes:
    lines = [f"add@{properties['DEVPATH']}", *(f"{key}={value}" for key, value in properties.items())]
    return "".join(f"{line}\0" for line in lines).encode()


def udev_event(**properties: str) -> bytes:
    """Systemd's device-monitor.c: prefix, magic, size of the header, offset and length, four hashes."""
    body = "".join(f"{key}={value}\0" for key, value in properties.items()).encode()
    return (
        b"libudev\0"
        + struct.pack(">I", 0xFEEDCAFE)
        + struct.pack("=7I", 40, 40, len(body), 1, 2, 3, 4)
        + body
    )


class Machine:
    """Its watches see this /dev and /sys; the device events that they get are those of the real kernel."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.dev, self.sys = root / "dev", root / "sys"
        self.watches: list[Watch] = []
        self.dev.mkdir()
        (self.sys / "class/tty").mkdir(parents=True)
        (self.sys / "bus/usb/devices").mkdir(parents=True)
        for module in (watch, serial):
            monkeypatch.setattr(module, "_DEV", self.dev)
        for module in (watch, sysfs):
            monkeypatch.setattr(module, "_SYS", self.sys)

    def plug(self, name: str, serial_number: str | None = None, *, node: str = "") -> Path:
        """A device with one serial line, called so, or with a raw one whose node is /dev/bus/usb/`node`."""
        usb = self.sys / "devices" / name
        directory = usb / f"1-1:1.0/{name}/tty/{name}"
        directory.mkdir(parents=True)
        (usb / "idVendor").write_text("0403\n")
        (usb / "idProduct").write_text("6001\n")
        if serial_number:
            (usb / "serial").write_text(f"{serial_number}\n")
        (self.sys / "class/tty" / name).symlink_to(directory)
        (self.sys / "bus/usb/devices" / name).symlink_to(usb)
        (self.sys / "bus/usb/devices" / f"{name}:1.0").mkdir()  # its interface
        if node:
            bus, address = node.split("/")
            (usb / "busnum").write_text(f"{int(bus)}\n")
            (usb / "devnum").write_text(f"{int(address)}\n")
            (self.dev / "bus/usb" / bus).mkdir(parents=True, exist_ok=True)
            (self.dev / "bus/usb" / node).touch()
        (self.dev / name).touch()
        return self.dev / name

    def unplug(self, name: str) -> None:
        (self.dev / name).unlink()
        for folder in ("class/tty", "bus/usb/devices"):
            (self.sys / folder / name).unlink()
        (self.sys / "bus/usb/devices" / f"{name}:1.0").rmdir()
        shutil.rmtree(self.sys / "devices" / name)

    def watch(self, port: Path | str, serial_number: str | None = None) -> Watch:
        self.watches.append(Watch(str(port), serial_number))
        return self.watches[-1]

    def close(self) -> None:
        for watching in self.watches:
            watching.close()
