"""The settings of one bridge, as frozen values. How a YAML file becomes these is told in config.py."""

from __future__ import annotations

import enum
from collections.abc import Collection, Iterable, Mapping  # noqa: TC003 - msgspec looks at the annotations
from pathlib import Path  # noqa: TC003 - as above
from typing import Any, ClassVar

from msgspec import Struct

from bridged.can import AcceptanceFilter, BitTiming  # noqa: TC001 - as above


class Restart(enum.Enum):
    """Who puts an adapter that is bus-off on its CAN bus again. The third way is `After`."""

    ITSELF = enum.auto()  # the adapter does; its channel stays open
    NEVER = enum.auto()  # its channel is closed until the interface comes up anew


class After(Struct, frozen=True):
    """The bridge closes the adapter's channel when that is bus-off, and opens it after so long."""

    seconds: float


class AdapterConfig(Struct, frozen=True, kw_only=True):
    """An adapter, and how to reach it: section `adapter` of a file.

    Each type of adapter has a subclass in adapters/: with the keys of its own, and with the rest below that
    config.py asks of it.
    """

    type: str
    port: str

    default_window: ClassVar[int]  # of section transmit, in frames
    default_restart: ClassVar[Restart | After]  # of section channel
    bitrates: ClassVar[Collection[int]]  # bit/s, those that take no BTR0 and BTR1
    identified_by_usb: ClassVar[bool] = False  # a key `serial_number` means the USB device behind `port`
    schemes: ClassVar[tuple[str, ...]]  # URLs that `port` may have
    refused_schemes: ClassVar[Mapping[str, str]] = {}  # why it may not have another, and what to do
    refused_keys: ClassVar[Mapping[str, str]] = {}  # the same of keys that other types of adapter have
    other_names: ClassVar[tuple[str, ...]] = ()  # that somebody might give as its `type`, in lower case
    other_names_advice: ClassVar[str] = ""  # what to do then, with `{}` for that name

    @classmethod
    def problems(cls, values: Mapping[str, Any], given: Collection[str]) -> Iterable[tuple[str, str]]:  # noqa: ARG003
        """A key and what is wrong with it, of `values` that are right by themselves but not together.

        `given`: all keys of the section, also those whose values are wrong by themselves.
        """
        return ()

    def window_problem(self, transmit: TransmitConfig) -> str | None:  # noqa: ARG002
        """Why the adapter cannot be used with this window."""
        return None

    def window_warning(self, transmit: TransmitConfig) -> str | None:  # noqa: ARG002
        """Why this window is probably not meant."""
        return None

    def notes(self, channel: ChannelConfig) -> list[str]:  # noqa: ARG002
        """Lines that somebody should know before the adapter is used with these settings."""
        return []

    @property
    def where(self) -> str:
        """The port, with the rate of its line if it has one: `/dev/ttyUSB0 at 57600 Bd`."""
        return self.port

    @property
    def usb_serial_number(self) -> str | None:
        """The wanted serial number of the USB device behind `port`. None: any, or it is not known by one."""
        return None


class ChannelConfig(Struct, frozen=True, kw_only=True):
    """The CAN bus behind the adapter. `acceptance` None: every frame passes. `restart`: after bus-off."""

    timing: BitTiming
    listen_only: bool = False
    acceptance: AcceptanceFilter | None = None
    restart: Restart | After = Restart.ITSELF


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
    """One bridge. `name`: the stem of the file's name; `notify`: a command that is told of each new state."""

    name: str
    path: Path
    adapter: AdapterConfig
    channel: ChannelConfig
    bus: BusConfig
    transmit: TransmitConfig
    health: HealthConfig = HealthConfig()
    reconnect: ReconnectConfig = ReconnectConfig()
    notify: tuple[str, ...] = ()
