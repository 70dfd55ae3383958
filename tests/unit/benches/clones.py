"""The simulators of firmware that is no CAN232, and of a CAN232, for a Host that drives them."""

from __future__ import annotations

from typing import Any

from bridged.simulators import SIMULATORS, make_device

CAN232 = "can232"
DEAF = {"usb2can", "cantact"}  # another protocol; answers nothing
FAMILIES = tuple(sorted(SIMULATORS.keys() - DEAF - {CAN232}))
OF_ANOTHER_FAMILY = {"nakakiyo-fd": ("nakakiyo", "VW1K2")}


def clone(name: str, *, is_open: bool = False) -> Any:
    """A device, switched on at 0; `is_open`: at 125 kbit/s, as another program has left it."""
    family, version = OF_ANOTHER_FAMILY.get(name, (name, None))
    device: Any = make_device(family, ["--version", version] if version else [], now=0.0)
    if not is_open:
        return device
    if family == CAN232:
        device.host_writes(0.0, b"S4\rO\r")
        device.advance(0.0)
        device.take_output(0.0)
    else:
        device.bitrate = 125_000.0
        device.open_channel(0.0)
    return device


def effects(device: Any) -> list[str]:
    """What nobody can take back: frames that it took to send, register and flash writes, a bootloader.

    A frame counts also if the device was closed before it could be on the bus: a real one is quicker.
    """
    counters = device.counters
    frames = counters.frames_taken + getattr(counters, "frames_vanished", 0)
    return [*getattr(device, "effects", ()), *["frame"] * frames]
