"""What can befall a simulated adapter: `silence@5+3` is silence from second 5 on, for 3 seconds."""

from __future__ import annotations

import argparse
import functools
import re
import sys
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    import random
    from collections.abc import Callable, Collection, Mapping

    from bridged.simulators.device import Device, OwnFault

FAULTS: Final = {
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
}
"""Those that every device has, and what they mean."""

BURST_S = 0.01  # between two bursts of a fault that lasts
NOISE_MAX = 16  # bytes in one of them


class Fault(NamedTuple):
    """One of the device's, `start_s` after the start; without a duration once, or for good."""

    kind: str
    start_s: float
    duration_s: float = 0.0


def meanings(own: Mapping[str, OwnFault]) -> dict[str, str]:
    """All faults of a device that has these of its own, and what they mean."""
    return FAULTS | {kind: fault.meaning for kind, fault in own.items()}


def parse_fault(text: str, kinds: Collection[str] = FAULTS.keys()) -> Fault:
    """`KIND@START[+DURATION]` in seconds, as `silence@5+3`; ArgumentTypeError if it is not."""
    match = re.fullmatch(r"([a-z]+[0-9]?)@(\d+\.?\d*)(?:\+(\d+\.?\d*))?", text)
    if not match or match[1] not in kinds:
        raise argparse.ArgumentTypeError(f"{text!r} is not KIND@START[+DURATION], KIND {', '.join(kinds)}")
    return Fault(match[1], float(match[2]), float(match[3] or 0))


def begin(device: Device, fault: Fault, now: float) -> None:
    """It happens to the device at `now`."""
    times = sys.maxsize if fault.duration_s else 1
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
            device.refusals = times
        case "drop":
            device.drop_answers = times
        case "reset":
            device.power_cycle(now)
        case "listenonly":
            device.set_listen_only(now, True)
        case "poweroff" | "unplug":
            device.power_off(now)
        case kind if own := device.own_faults.get(kind):
            if own.switch:
                own.switch(device, now, times)


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
        case "drop":
            device.drop_answers = 0
        case "listenonly":
            device.set_listen_only(now, False)
        case "poweroff" | "unplug":
            device.power_on(now)
        case kind if own := device.own_faults.get(kind):
            if own.switch:
                own.switch(device, now, 0)


def repeated(device: Device, fault: Fault, noise: random.Random) -> Callable[[float], None] | None:
    """What happens every BURST_S until it is over, or once if it has no duration; None: nothing does."""
    if fault.kind == "garbage":
        return lambda now: device.garbage(now, noise.randbytes(noise.randint(1, NOISE_MAX)))
    own = device.own_faults.get(fault.kind)
    return functools.partial(own.burst, device) if own and own.burst else None
