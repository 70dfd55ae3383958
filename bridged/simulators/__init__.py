"""Devices in pure Python, an independent reading of their manuals; no code shared with codecs or adapters.

And the registry of them all: device.py says what a module must have to stand here.
"""

from __future__ import annotations

import argparse
import importlib
import time
from typing import TYPE_CHECKING, Final, cast

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bridged.simulators.device import Device, SimulatorModule

SIMULATORS: Final = {
    "can232": "bridged.simulators.can232",
    "usb2can": "bridged.simulators.usb2can",
    "canable1": "bridged.simulators.canable1",
    "canable2": "bridged.simulators.canable2",
    "cantact": "bridged.simulators.cantact",
    "catompiler": "bridged.simulators.catompiler",
    "elmue": "bridged.simulators.elmue",
    "esp32": "bridged.simulators.esp32",
    "nakakiyo": "bridged.simulators.nakakiyo",
    "slcanpty": "bridged.simulators.slcanpty",
    "slcanuino": "bridged.simulators.slcanuino",
    "usbtin": "bridged.simulators.usbtin",
    "weact": "bridged.simulators.weact",
    "replay": "bridged.simulators.replay",
}
"""ADAPTER in `can-bridge simulate ADAPTER` → its module, loaded only when it is needed."""


def simulator(name: str) -> SimulatorModule:
    """The module of one of SIMULATORS."""
    return cast("SimulatorModule", importlib.import_module(SIMULATORS[name]))


def make_device(
    name: str, options: Sequence[str] = (), *, now: float | None = None, uart_rate: int | None = None
) -> Device:
    """The device of `can-bridge simulate NAME OPTIONS`; of the options those that only this one has.

    It is switched on at `now`, default: time.monotonic(). `uart_rate` is that of its serial line if it has
    one: then it has the attribute `uart`.
    """
    module = simulator(name)
    parser = argparse.ArgumentParser(name)
    module.add_arguments(parser)
    parser.set_defaults(processing=0.0, uart_rate=uart_rate)
    return module.make_device(time.monotonic() if now is None else now, parser.parse_args(options))
