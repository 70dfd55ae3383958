"""A machine's /sys and /dev, with the USB devices and serial ports that a test plugs in."""

from __future__ import annotations

from pathlib import Path

import pytest

from bridged.ports import inventory, sysfs


class FakeMachine:
    """Its nodes in /dev are empty files."""

    def __init__(self, top: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sys, self.dev = top / "sys", top / "dev"
        for module in (inventory, sysfs):
            monkeypatch.setattr(module, "_SYS", self.sys)
        monkeypatch.setattr(inventory, "_DEV", self.dev)
        (self.sys / "class/tty").mkdir(parents=True)
        (self.sys / "bus/usb/devices").mkdir(parents=True)
        self.dev.mkdir()
        self._devices = 0

    def plug(
        self, place: str, usb_id: str, *, ttys: dict[int, str] | None = None, driver: str = "", **texts: str
    ) -> Path:
        """A USB device at `3-1.4` with these names; `ttys`: the serial port of each interface."""
        self._devices += 1
        device = self.sys / "devices/pci0/usb3" / place
        vendor, product = usb_id.split(":")
        texts |= {"idVendor": vendor, "idProduct": product, "busnum": "3", "devnum": str(self._devices)}
        device.mkdir(parents=True)
        for name, text in texts.items():
            (device / name).write_text(f"{text}\n")
        (self.sys / "bus/usb/devices" / place).symlink_to(device)
        node = self.dev / f"bus/usb/003/{self._devices:03}"
        node.parent.mkdir(parents=True, exist_ok=True)
        node.touch()
        for interface, tty in (ttys or {}).items():
            self._add_tty(device / f"{place}:1.{interface}/{tty}", driver)
        if driver and not ttys:
            self._bind(device / f"{place}:1.0", driver)
        return device

    def add_uart(self, tty: str, type_: int) -> None:
        """A serial port of the machine itself; type 0 has no chip."""
        directory = self._add_tty(self.sys / f"devices/pnp0/{tty}", "serial")
        (directory / "type").write_text(f"{type_}\n")

    def link(self, name: str, tty: str) -> None:
        """As udev makes it: `by-id/usb-…` in /dev/serial."""
        link = self.dev / "serial" / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(self.dev / tty)

    def _add_tty(self, parent: Path, driver: str) -> Path:
        directory = parent / "tty" / parent.name
        directory.mkdir(parents=True)
        (directory / "device").symlink_to(parent)
        self._bind(parent, driver)
        (self.sys / "class/tty" / parent.name).symlink_to(directory)
        (self.dev / parent.name).touch()
        return directory

    def _bind(self, directory: Path, driver: str) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        target = self.sys / "bus/drivers" / driver
        target.mkdir(parents=True, exist_ok=True)
        (directory / "driver").symlink_to(target)
