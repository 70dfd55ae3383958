"""What can befall a simulated adapter: `silence@5+3` is silence from second 5 on, for 3 seconds."""

from __future__ import annotations

import argparse
import functools
import re
import sys
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import random
    from collections.abc import Callable, Sequence

    from bridged.simulators.can232 import Can232
    from bridged.simulators.device import Device
    from bridged.simulators.usb2can import Usb2can

BUS_FAULTS = ("warning", "passive", "busoff")
HOST_FAULTS = ("silence", "garbage", "refuse", "drop", "reset", "listenonly", "poweroff", "unplug")
FAULTS = (*HOST_FAULTS, *BUS_FAULTS)
CAN232_FAULTS = (*FAULTS, "refuseall")
USB2CAN_FAULTS = (*FAULTS, "lostgo", "value2", "overrun")

MEANINGS = {
    "silence": "the adapter answers nothing",
    "garbage": "noise on the line",
    "refuse": "it refuses a frame, with a duration all",
    "drop": "an answer is lost, with a duration all",
    "reset": "it restarts and has forgotten its settings",
    "listenonly": "it is put into listen-only by itself",
    "poweroff": "no power, its line stays",
    "unplug": "its terminal goes, and with a duration comes back",
    "warning": "its CAN bus is error-warning",
    "passive": "its CAN bus is error-passive",
    "busoff": "its CAN bus is bus-off",
    "refuseall": "it refuses each command",
    "lostgo": "it does not say 'go on' after 'stop'",
    "value2": "20 messages about its transmit buffer, of a value that its document does not know",
    "overrun": "it has lost received frames",
}

BURST_S = 0.01  # between two bursts of a fault that lasts
NOISE_MAX = 16  # bytes in one of them
VALUE_2_BURST = 20  # messages


class Fault(NamedTuple):
    """One of the device's, `start_s` after the start; without a duration once, or for good."""

    kind: str
    start_s: float
    duration_s: float = 0.0


def parse_fault(text: str, kinds: Sequence[str] = FAULTS) -> Fault:
    """`KIND@START[+DURATION]` in seconds, as `silence@5+3`; ArgumentTypeError if it is not."""
    match = re.fullmatch(r"([a-z]+[0-9]?)@(\d+\.?\d*)(?:\+(\d+\.?\d*))?", text)
    if not match or match[1] not in kinds:
        raise argparse.ArgumentTypeError(f"{text!r} is not KIND@START[+DURATION], KIND {', '.join(kinds)}")
    return Fault(match[1], float(match[2]), float(match[3] or 0))


def begin(device: Device, fault: Fault, now: float) -> None:
    """It happens to the device at `now`."""
    match fault.kind:
        case "silence":
            device.silent = True
        case "warning":
            device.set_error_counters(now, 100, 3)
        case "passive":
            device.set_error_counters(now, 130, 3)
        case "busoff":
            device.set_bus_off(now, True)
        case "refuse":
            device.refusals = sys.maxsize if fault.duration_s else 1
        case "refuseall":
            _can232(device).refuses_all = True
        case "drop":
            device.drop_answers = sys.maxsize if fault.duration_s else 1
        case "lostgo":
            _usb2can(device).lose_go = sys.maxsize if fault.duration_s else 1
        case "reset":
            device.power_cycle(now)
        case "listenonly":
            device.set_listen_only(now, True)
        case "poweroff" | "unplug":
            device.power_off(now)


def end(device: Device, fault: Fault, now: float) -> None:
    """Its duration is over."""
    match fault.kind:
        case "silence":
            device.silent = False
        case "warning" | "passive":
            device.set_error_counters(now, 0, 0)
        case "busoff":
            device.set_bus_off(now, False)
        case "refuse":
            device.refusals = 0
        case "refuseall":
            _can232(device).refuses_all = False
        case "drop":
            device.drop_answers = 0
        case "lostgo":
            _usb2can(device).lose_go = 0
        case "listenonly":
            device.set_listen_only(now, False)
        case "poweroff" | "unplug":
            device.power_on(now)


def repeated(device: Device, fault: Fault, noise: random.Random) -> Callable[[float], None] | None:
    """What happens every BURST_S until it is over, or once if it has no duration; None: nothing does."""
    match fault.kind:
        case "garbage":
            return lambda now: device.garbage(now, noise.randbytes(noise.randint(1, NOISE_MAX)))
        case "value2":
            return functools.partial(_usb2can(device).value_2_burst, count=VALUE_2_BURST)
        case "overrun":
            return _usb2can(device).overrun
    return None


def _can232(device: Device) -> Can232:
    """The device, whose fault only it has; so below."""
    from bridged.simulators.can232 import Can232  # noqa: PLC0415 - only the adapter in use is loaded

    assert isinstance(device, Can232)
    return device


def _usb2can(device: Device) -> Usb2can:
    from bridged.simulators.usb2can import Usb2can  # noqa: PLC0415 - as above

    assert isinstance(device, Usb2can)
    return device
