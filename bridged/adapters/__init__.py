"""What is particular to a device, without I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bridged.adapters.base import Adapter, Memory
    from bridged.config import Config


def make_adapter(config: Config, memory: Memory) -> Adapter:
    """The adapter that the configuration names."""
    from bridged.adapters.can232 import Can232  # noqa: PLC0415 - only the adapter in use is loaded

    return Can232(config.adapter, config.channel, memory)
