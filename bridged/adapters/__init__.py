"""What is particular to a device, without I/O; and the registry of all types of adapter."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from bridged.adapters.base import Adapter, Memory
    from bridged.settings import AdapterConfig, Config

TYPES: Final = {
    "can232": "bridged.adapters.can232",
    "usb2can": "bridged.adapters.usb2can",
}
"""`type` in a configuration → its module, loaded only when it is needed.

Each module has `SETTINGS`, a subclass of AdapterConfig, and `make_adapter(settings, channel, memory)`.
"""


def _module(type_: str) -> Any:
    return importlib.import_module(TYPES[type_])


def settings_of(type_: str) -> type[AdapterConfig]:
    """The settings that a type of adapter has."""
    settings: type[AdapterConfig] = _module(type_).SETTINGS
    return settings


def make_adapter(config: Config, memory: Memory) -> Adapter:
    """The adapter that the configuration names."""
    adapter: Adapter = _module(config.adapter.type).make_adapter(config.adapter, config.channel, memory)
    return adapter
