"""What is particular to a device, without I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bridged.adapters.base import Adapter, Memory
    from bridged.settings import Config


def make_adapter(config: Config, memory: Memory) -> Adapter:
    """The adapter that the configuration names; only its module is loaded."""
    adapter: Any = config.adapter
    if adapter.type == "usb2can":
        from bridged.adapters.usb2can import Usb2can  # noqa: PLC0415

        return Usb2can(adapter, config.channel)
    from bridged.adapters.can232 import Can232  # noqa: PLC0415

    return Can232(adapter, config.channel, memory)
