"""The command `list`: what could be an adapter here, who uses it, and what its user has to do first."""

from __future__ import annotations

import json
import os
import sys
import textwrap
from typing import TYPE_CHECKING, Any

from bridged.adapters.usb_families import family_of
from bridged.daemon.status import StatusError, query, running_sockets
from bridged.ports import inventory, sysfs
from bridged.text import printable

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from bridged.adapters.usb_families import Family
    from bridged.ports.inventory import Device

WIDTH = 98  # where the output is no terminal
LABEL = 12  # characters
NOTHING = (
    "There is no serial port and no USB device that is known as an adapter. Plug it in: `journalctl -kf` "
    "shows whether the kernel finds it. The adapter behind a serial server is not listed; its port is "
    "socket://HOST:PORT. Without any adapter: `can-bridge demo`, or `can-bridge simulate`."
)
NO_DRIVER = "none: `modprobe -a ftdi_sio cdc_acm ch341` makes a serial port of it, if it is to have one"
ONLY_YOURS = "Programs of other users are not seen: ask as root (sudo) for those, too."


def run(args: argparse.Namespace) -> int:
    """Prints the list; the exit status is 0 also where it is empty."""
    bridges, unknown = _bridges()
    found = [_described(device, family, bridges) for device, family in _candidates()]
    if args.json:
        print(json.dumps(found, indent=2))
        return 0
    blocks = [_lines(device) for device in found] or [[NOTHING]]
    blocks += [[text] for text in unknown]
    if found and os.geteuid() != 0:
        blocks.append([ONLY_YOURS])
    print("\n\n".join(_fitted(block) for block in blocks))
    return 0


def _candidates() -> list[tuple[Device, Family | None]]:
    """Every serial port, and each USB device without one that is known."""
    pairs = [
        (device, family_of(device.usb.id, device.usb.product) if device.usb else None)
        for device in inventory.devices()
    ]
    return [(device, family) for device, family in pairs if family or device.is_tty]


def _bridges() -> tuple[list[dict[str, Any]], list[str]]:
    """The status of each bridge that runs, and a line for each that may not be asked."""
    answered, unknown = [], []
    for path in running_sockets():
        try:
            answered.append(query(path))
        except StatusError as error:
            unknown.append(printable(f"Bridge {path.stem} is not known: {error}."))
    return answered, unknown


def _described(device: Device, family: Family | None, bridges: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One object of the JSON list."""
    usb = device.usb
    return {
        "port": device.port or None,
        "node": str(device.node),
        "driver": device.driver,
        "usb": usb
        and {
            "id": f"{usb.id[0]:04x}:{usb.id[1]:04x}",
            "manufacturer": usb.manufacturer,
            "product": usb.product,
            "serial_number": usb.serial_number,
        },
        "family": family.title if family else None,
        "type": family.type if family else None,
        "used_by": _users(device, bridges),
        "refused": device.refusal() or None,
    }


def _users(device: Device, bridges: Sequence[dict[str, Any]]) -> list[str]:
    """Bridges by their status, other programs as far as they can be seen."""
    found = []
    seen = sysfs.users(device.node)
    for status in bridges:
        adapter = status.get("adapter")
        name = printable(str(status.get("name")))
        if isinstance(adapter, dict) and device.is_meant_by(str(adapter.get("port"))):
            found.append(f"bridge {name} ({printable(str(status.get('state')))})")
            seen = [user for user in seen if not user.startswith(f"bridge {name} (")]
    return found + seen


def _lines(found: dict[str, Any]) -> list[str]:
    """`port: …` as it is written in a configuration, then what is known."""
    usb = found["usb"]
    driver = f", driver {found['driver']}" if found["driver"] else ""
    parts = {"device": found["node"] + driver}
    if usb:
        number = usb["serial_number"] and f"serial number {usb['serial_number']}"
        parts["USB"] = ", ".join(filter(None, (usb["id"], usb["manufacturer"], usb["product"], number)))
    if found["family"]:
        type_ = f" (type: {found['type']})" if found["type"] else ""
        parts["may be"] = found["family"] + type_
    if usb and not found["driver"]:
        parts["driver"] = NO_DRIVER
    nobody = "nobody" if os.geteuid() == 0 else "none of your programs"
    parts["used by"] = ", ".join(found["used_by"]) or nobody
    if found["refused"]:
        parts["refused"] = found["refused"]
    head = f"port: {found['port']}" if found["port"] else "no port for a bridge"
    return [head, *(f"  {name:<{LABEL - 2}}{text}" for name, text in parts.items())]


def _fitted(lines: Sequence[str]) -> str:
    """Each line folded to the terminal's width; words stay whole, since they are copied."""
    return "\n".join(
        textwrap.fill(
            line,
            _width(),
            subsequent_indent=" " * LABEL * line.startswith(" "),
            break_long_words=False,
            break_on_hyphens=False,
        )
        for line in lines
    )


def _width() -> int:
    try:
        return os.get_terminal_size(sys.stdout.fileno()).columns or WIDTH
    except (OSError, ValueError):
        return WIDTH
