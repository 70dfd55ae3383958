"""The settings of one bridge, as frozen values. How a YAML file becomes these is told in config.py."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003 - msgspec looks at the annotations
from typing import Any

from msgspec import Struct

from bridged.can import AcceptanceFilter, BitTiming  # noqa: TC001 - as above


class AdapterConfig(Struct, frozen=True, kw_only=True):
    """An adapter, and how to reach it. Each type of adapter has a subclass, with the keys of its own."""

    type: str
    port: str

    @property
    def usb_serial_number(self) -> str | None:
        """The wanted serial number of the USB device behind `port`. None: any, or it is not known by one."""
        return None


class ChannelConfig(Struct, frozen=True, kw_only=True):
    """The CAN bus behind the adapter. `acceptance` None: every frame passes.

    `restart_s`: after bus-off the channel is closed, and opened again after so long; None: not until the
    interface comes up anew; 0: it stays open, the adapter restarts itself.
    """

    timing: BitTiming
    listen_only: bool = False
    acceptance: AcceptanceFilter | None = None
    restart_s: float | None = 0.0


class BusConfig(Struct, frozen=True, kw_only=True):
    """The CAN interface on the host's side; `options` go to python-can as keyword arguments."""

    interface: str = "socketcan"
    channel: str
    create: bool = False
    options: dict[str, Any] = {}


class TransmitConfig(Struct, frozen=True, kw_only=True):
    """How frames wait for the adapter: `queue` and `window` in frames; dropped after `deadline_s`."""

    queue: int
    window: int
    deadline_s: float


class HealthConfig(Struct, frozen=True, kw_only=True):
    """The adapter is asked each `interval_s`; `error_frames`: bus states go to the interface as such."""

    interval_s: float = 0.25
    error_frames: bool = True


class ReconnectConfig(Struct, frozen=True, kw_only=True):
    """The pause before the adapter is tried again: `initial_s`, then doubling up to `maximum_s`."""

    initial_s: float = 0.1
    maximum_s: float = 5.0


class Config(Struct, frozen=True, kw_only=True):
    """One bridge. `name` is the stem of the file's name."""

    name: str
    path: Path
    adapter: AdapterConfig
    channel: ChannelConfig
    bus: BusConfig
    transmit: TransmitConfig
    health: HealthConfig = HealthConfig()
    reconnect: ReconnectConfig = ReconnectConfig()
