"""The configuration: a YAML file becomes frozen, typed values, or a list of all that is wrong with it."""

import os
import re
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from bridged import can
from bridged.ports.names import USB_DEVICE, is_numbered_terminal, port_problem
from bridged.settings import (
    AdapterConfig,
    BusConfig,
    ChannelConfig,
    Config,
    HealthConfig,
    ReconnectConfig,
    TransmitConfig,
)
from bridged.text import quoted
from bridged.yaml_source import (
    Problems,
    Section,
    foreign_tag,
    is_empty,
    key_names,
    parse,
    read_text,
    scalar_value,
)

CRITICAL_LIMIT, READY_LIMIT = 15, 7
"""Frames. Known to work, and with the fewest ERROR messages of the pairs that were tried on a real one."""

LONG_DEADLINE_S = 10.0
CAN232_COMMANDS = 2
"""What its serial buffer holds: CAN232 manual."""

# --- The schema. A description completes "expected …, got the text 'fast'". ----------------------

ADAPTER_TYPES = Meta(description="can232 or usb2can")
Flag = Annotated[bool, Meta(description="true or false")]
Port = Annotated[
    str, Meta(min_length=1, description="a device path like /dev/ttyUSB0 or a URL like socket://HOST:PORT")
]
Baudrate = Annotated[int, Meta(ge=50, le=4_000_000, description="a UART rate from 50 to 4000000 bit/s")]
SerialNumber = Annotated[
    str, Meta(pattern="^[!-~]{1,32}$", description="the serial number that the device reports")
]
Firmware = Annotated[Literal["can232"], Meta(description="can232")]
CriticalLimit = Annotated[int, Meta(ge=2, le=18, description="a number of frames from 2 to 18")]
ReadyLimit = Annotated[
    int, Meta(ge=1, le=17, description="a number of frames from 1 to 17")
]  # below 1 never "go"
Bitrate = Annotated[
    int,
    Meta(
        ge=10_000,
        le=can.MAX_BITRATE,
        description="a bit rate from 10000 to 1000000 bit/s (a slower one by btr0 and btr1)",
    ),
]
Register = Annotated[int, Meta(ge=0, le=0xFF, description="a register value from 0x00 to 0xFF")]
SamplePoint = Annotated[
    float, Meta(ge=0.5, le=0.95, description="a fraction of the bit time from 0.5 to 0.95")
]
Restart = Annotated[
    Annotated[int, Meta(ge=1, le=60_000)] | Literal["never"],
    Meta(description="a number of milliseconds from 1 to 60000, or never"),
]
Word = Annotated[int, Meta(ge=0, le=0xFFFFFFFF, description="a number from 0x00000000 to 0xFFFFFFFF")]
FilterMode = Annotated[Literal["dual", "single"], Meta(description="dual or single")]
InterfaceType = Annotated[
    str,
    Meta(pattern=r"^[A-Za-z0-9_.-]+$", description="socketcan or the name of another python-can interface"),
]
InterfaceName = Annotated[str, Meta(min_length=1, description="the name of an interface")]
QueueLength = Annotated[int, Meta(ge=1, le=65_536, description="a number of frames from 1 to 65536")]
Window = Annotated[int, Meta(ge=1, le=32, description="a number of unanswered frames from 1 to 32")]
Interval = Annotated[float, Meta(ge=0.1, le=0.5, description="a number of seconds from 0.1 to 0.5")]
Pause = Annotated[float, Meta(ge=0.01, le=3600, description="a number of seconds from 0.01 to 3600")]
Deadline = Annotated[float, Meta(gt=0, le=3600, description="a number of seconds above 0 and up to 3600")]


class _AdapterKeys(Struct, frozen=True, kw_only=True):
    type: Annotated[Literal["can232", "usb2can"], ADAPTER_TYPES]
    port: Port
    baudrate: Baudrate | None = None
    serial_number: SerialNumber | None = None
    firmware: Firmware | None = None
    critical_limit: CriticalLimit | None = None
    ready_limit: ReadyLimit | None = None


class Can232Config(AdapterConfig, frozen=True, kw_only=True):
    """A CAN232, and how to reach it. `port` is an absolute path or a pyserial URL; `baudrate` in bit/s.

    `firmware` "can232": what is there is a CAN232 for certain; None: it may be a clone, and is treated so
    until it has said what it is.
    """

    default_window: ClassVar[int] = 1
    default_restart_s: ClassVar[float] = 0.1

    type: Annotated[Literal["can232"], ADAPTER_TYPES]
    port: Port
    baudrate: Baudrate = 57_600
    serial_number: SerialNumber | None = None
    firmware: Firmware | None = None


class Usb2canConfig(AdapterConfig, frozen=True, kw_only=True):
    """A USB2CAN, and how to reach it. `port` is an absolute path, socket:// or usb://VID:PID[/SERIAL].

    With so many frames in its transmit buffer the adapter says stop (`critical_limit`) and go on
    (`ready_limit`, always below): USB2CAN document, COMMAND 0 and 1. `serial_number` is the USB device's.
    """

    default_window: ClassVar[int] = 16
    default_restart_s: ClassVar[float] = 0.0  # it restarts itself

    type: Annotated[Literal["usb2can"], ADAPTER_TYPES]
    port: Port
    serial_number: SerialNumber | None = None
    critical_limit: CriticalLimit = CRITICAL_LIMIT
    ready_limit: ReadyLimit = READY_LIMIT

    @property
    def usb_serial_number(self) -> str | None:
        return self.serial_number


class _AcceptanceKeys(Struct, frozen=True, kw_only=True):
    code: Word
    mask: Word
    mode: FilterMode = "dual"


class _ChannelKeys(Struct, frozen=True, kw_only=True):
    bitrate: Bitrate | None = None
    btr0: Register | None = None
    btr1: Register | None = None
    sample_point: SamplePoint | None = None
    listen_only: Flag = False
    acceptance: _AcceptanceKeys | None = None
    restart: Restart | None = None


class _BusKeys(Struct, frozen=True, kw_only=True):
    interface: InterfaceType = "socketcan"
    channel: InterfaceName
    create: Flag = False


class _TransmitKeys(Struct, frozen=True, kw_only=True):
    queue: QueueLength = 1024
    window: Window | None = None
    deadline_s: Deadline = msgspec.field(default=1.0, name="deadline")


class _HealthKeys(Struct, frozen=True, kw_only=True):
    interval_s: Interval | None = msgspec.field(default=None, name="interval")
    error_frames: Flag | None = None


class _ReconnectKeys(Struct, frozen=True, kw_only=True):
    initial_s: Pause | None = msgspec.field(default=None, name="initial")
    maximum_s: Pause | None = msgspec.field(default=None, name="maximum")


_SECTIONS: dict[str, type[Struct]] = {
    "adapter": _AdapterKeys,
    "channel": _ChannelKeys,
    "channel.acceptance": _AcceptanceKeys,
    "bus": _BusKeys,
    "transmit": _TransmitKeys,
    "health": _HealthKeys,
    "reconnect": _ReconnectKeys,
}

_ADAPTERS: dict[str, type[Can232Config | Usb2canConfig]] = {"can232": Can232Config, "usb2can": Usb2canConfig}

_SPOKEN_BY_CAN232 = ("slcan", "slcand", "lawicel")

_KEYS_OF_OTHERS = {
    "can232": {
        "critical_limit": "goes with type: usb2can; remove it",
        "ready_limit": "goes with type: usb2can; remove it",
    },
    "usb2can": {
        "baudrate": "a USB2CAN has no baud rate, there is no serial line in it: remove it",
        "firmware": "goes with type: can232; remove it",
    },
}

_RESERVED_OPTIONS = {
    "bustype": "write interface",
    "receive_own_messages": "the bridge needs it off: it would send frames back to where they came from",
}
"""Keyword arguments of can.Bus that are not for the user."""


def load(path: str | os.PathLike[str]) -> Config:
    """Return the configuration in a file; ConfigError with all problems, each with line and column."""
    return _load(Path(path))[0]


def check(path: str | os.PathLike[str]) -> tuple[Config, list[str]]:
    """Return what load() does, and a line for each thing that is allowed but probably not meant.

    ConfigError also where python-can lacks what the interface needs, which takes importing it.
    """
    config, top = _load(Path(path))
    adapter, transmit = config.adapter, config.transmit
    section = top.section("adapter")
    if section and is_numbered_terminal(adapter.port):
        text = (
            "the next terminal gets this name when this one ends: use one that stays, as of simulate --link"
        )
        section.warn_key("port", text)
    section = top.section("transmit") if "transmit" in top.nodes else None
    if section and transmit.deadline_s > LONG_DEADLINE_S:
        section.warn_key("deadline", f"a frame may reach the bus {transmit.deadline_s:g} s after it was sent")
    if section and isinstance(adapter, Can232Config) and transmit.window > CAN232_COMMANDS:
        text = f"a CAN232 can hold {CAN232_COMMANDS} commands, more of them may be lost"
        section.warn_key("window", text)
    section = top.section("bus")
    if section and config.bus.create and re.fullmatch(r"can\d+", config.bus.channel):
        text = "a virtual interface of this name is made if there is none, so a real one cannot have it"
        section.warn_key("channel", text)
    if section and config.bus.interface != "socketcan":
        _check_python_can(section, config.bus)
    if top.problems:
        raise top.problems.error()
    return config, top.problems.warnings()


def _check_python_can(section: Section, bus: BusConfig) -> None:
    from bridged.interfaces import backends  # noqa: PLC0415 - python-can costs 85 ms and 19 MB

    if text := backends.interface_problem(bus.interface):
        section.refuse_value("interface", text)
        return
    for key in bus.options:
        if problem := backends.option_problem(bus.interface, key):
            text, refused = problem
            (section.refuse_key if refused else section.warn_key)(key, text)


def _load(file: Path) -> tuple[Config, Section]:
    path = str(file)
    problems = Problems(path)
    root = parse(read_text(file, problems), problems)
    if not isinstance(root, MappingNode) or foreign_tag(root):
        empty = root is None or is_empty(root)
        what = "the file is empty" if empty else "the file is no mapping (a 'key: value' in each line)"
        line, column = (0, 0) if root is None else (root.start_mark.line, root.start_mark.column)
        problems.add(line, column, f"{what}; expected sections adapter, channel and bus")
        raise problems.error()
    top = Section(root, _SECTIONS, problems)
    config = _read_file(file, top)
    if config is None:
        raise problems.error()
    return config, top


def _read_file(path: Path, top: Section) -> Config | None:
    top.refuse_unknown([path for path in _SECTIONS if "." not in path])
    adapter = _read_adapter(top.section("adapter"))
    channel_section = top.section("channel")
    channel = _read_channel(channel_section, adapter)
    bus = _read_bus(top.section("bus"))
    transmit_section = top.section("transmit", required=False) if "transmit" in top.nodes else None
    transmit = _read_transmit(transmit_section, adapter)
    if "transmit" in top.nodes and channel_section and channel_section.values.get("listen_only"):
        top.refuse_key(
            "transmit", "nothing is sent with channel.listen_only: true; remove this section, or listen_only"
        )
    health: HealthConfig | None = HealthConfig()
    if "health" in top.nodes:
        health = _read_plain(top.section("health", required=False), _HealthKeys, HealthConfig)
    reconnect = _read_reconnect(top)
    if top.problems or not (adapter and channel and bus and transmit and health and reconnect):
        return None
    return Config(
        name=path.stem,
        path=path,
        adapter=adapter,
        channel=channel,
        bus=bus,
        transmit=transmit,
        health=health,
        reconnect=reconnect,
    )


_S = TypeVar("_S", bound=Struct)


def _read_plain(section: Section | None, schema: type[Struct], settings: type[_S]) -> _S | None:
    """Read a section in which every key stands for itself; None, reported, if one is missing or wrong."""
    if section is None:
        return None
    values = section.read(schema)
    complete = all(field.name in values or not field.required for field in msgspec.structs.fields(schema))
    return settings(**values) if complete else None


def _read_adapter(section: Section | None) -> Can232Config | Usb2canConfig | None:
    if section is None:
        return None
    node = section.nodes.get("type")
    if isinstance(node, ScalarNode) and node.value.lower() in _SPOKEN_BY_CAN232:
        meant = f"a CAN232 speaks what {quoted(node.value)} names, LAWICEL's protocol: write type: can232"
        section.refuse_value("type", meant)
        node.value = "can232"  # for the other keys
    type_: str | None = node.value if isinstance(node, ScalarNode) and node.value in _ADAPTERS else None
    adapter: Can232Config | Usb2canConfig | None = None
    if type_ is None:
        section.read(_AdapterKeys)
    else:
        for key, why in _KEYS_OF_OTHERS[type_].items():
            if key in section.keys:
                section.refuse_key(key, why)
                del section.keys[key]  # or it would be reported as unknown too
        adapter = _read_plain(section, _ADAPTERS[type_], _ADAPTERS[type_])
    if text := port_problem(section.values.get("port", "/"), type_):
        section.refuse_value("port", text)
    if type_ == "usb2can":
        _check_serial_number(section)
        _check_limits(section)
    return adapter


def _check_serial_number(section: Section) -> None:
    """Report one that could not be kept to: a USB2CAN has no command that tells it, only USB knows it."""
    serial_number = section.values.get("serial_number")
    scheme, _, device = section.values.get("port", "").partition("://")
    if serial_number is None:
        return
    if scheme == "socket":
        section.refuse_key("serial_number", "is the USB device's, unknown through socket://; remove it")
    match = USB_DEVICE.fullmatch(device)
    if scheme == "usb" and match and match[1] not in (None, serial_number):
        text = f"{quoted(serial_number)} is not the one in port, {quoted(match[1])}; remove one of them"
        section.refuse_value("serial_number", text)


def _check_limits(section: Section) -> None:
    """Report limits that would have the adapter say go on before it says stop."""
    given = [key for key in ("critical_limit", "ready_limit") if key in section.nodes]
    if any(key not in section.values for key in given):  # reported already
        return
    critical = section.values.get("critical_limit", CRITICAL_LIMIT)
    ready = section.values.get("ready_limit", READY_LIMIT)
    if ready < critical:
        return
    default = ", its default" if len(given) == 1 else ""
    if "ready_limit" in given:
        text = f"expected a limit below critical_limit ({critical}{default}), got {ready}"
    else:
        text = f"expected a limit above ready_limit ({ready}{default}), got {critical}"
    section.refuse_value(given[-1], text)


def _read_transmit(
    section: Section | None, adapter: Can232Config | Usb2canConfig | None
) -> TransmitConfig | None:
    """Read `transmit`; without the section, and for what it leaves out, its defaults."""
    keys = _read_plain(section, _TransmitKeys, _TransmitKeys) or _TransmitKeys()
    if adapter is None:
        return None
    window = adapter.default_window if keys.window is None else keys.window
    transmit = TransmitConfig(queue=keys.queue, window=window, deadline_s=keys.deadline_s)
    if section and isinstance(adapter, Can232Config) and (text := _window_problem(adapter, transmit)):
        section.refuse_value("window", text)
    return transmit


def _window_problem(adapter: Can232Config, transmit: TransmitConfig) -> str | None:
    """The frames of a window lie in the line, where they grow old uncounted: 27 characters each."""
    if transmit.window == 1 or "://" in adapter.port:
        return None
    frame_s = 27 * 10 / adapter.baudrate
    room = max(1, int(transmit.deadline_s / 2 / frame_s))
    if transmit.window <= room:
        return None
    taken = f"{transmit.window} frames take {transmit.window * frame_s:.2g} s at {adapter.baudrate} Bd"
    limit = f"more than half of the deadline of {transmit.deadline_s:g} s"
    return f"{taken}, {limit}, so they could be sent late; at most {room}"


def _read_reconnect(top: Section) -> ReconnectConfig | None:
    if "reconnect" not in top.nodes:
        return ReconnectConfig()
    section = top.section("reconnect", required=False)
    reconnect = _read_plain(section, _ReconnectKeys, ReconnectConfig)
    if section and reconnect and reconnect.initial_s > reconnect.maximum_s:
        text = f"initial ({reconnect.initial_s:g} s) is more than maximum ({reconnect.maximum_s:g} s)"
        section.refuse_value("maximum" if "maximum" in section.nodes else "initial", text)
    return reconnect


def _read_channel(
    section: Section | None, adapter: Can232Config | Usb2canConfig | None
) -> ChannelConfig | None:
    if section is None:
        return None
    values = section.read(_ChannelKeys)
    timing = _read_timing(section)
    acceptance = None
    if "acceptance" in section.nodes and (
        keys := _read_plain(section.section("acceptance", required=False), _AcceptanceKeys, _AcceptanceKeys)
    ):
        acceptance = can.AcceptanceFilter(keys.code, keys.mask, single=keys.mode == "single")
    if timing is None or adapter is None:
        return None
    restart: int | str | None = values.get("restart")
    if isinstance(restart, int):
        restart_s: float | None = restart / 1000
    else:
        restart_s = None if restart == "never" else adapter.default_restart_s
    return ChannelConfig(
        timing=timing,
        listen_only=values.get("listen_only", False),
        acceptance=acceptance,
        restart_s=restart_s,
    )


def _read_timing(section: Section) -> can.BitTiming | None:
    """Make the bit timing of `bitrate` (and `sample_point`), or of `btr0` and `btr1`."""
    registers = [key for key in ("btr0", "btr1") if key in section.nodes]
    if "bitrate" in section.nodes:
        if registers:
            section.refuse_key(registers[0], "excludes bitrate; give bitrate, or btr0 and btr1")
            return None
        return _timing_of_bitrate(section)
    if not registers:
        section.refuse_missing("bitrate", "a bit rate in bit/s (or btr0 and btr1)")
        return None
    if "sample_point" in section.nodes:
        section.refuse_key(
            "sample_point", "goes with bitrate; btr0 and btr1 say already where a bit is sampled"
        )
    if len(registers) == 1:
        section.refuse_key(registers[0], "is half of a pair; give both btr0 and btr1, or bitrate")
        return None
    try:
        return can.BitTiming.from_registers(section.values["btr0"], section.values["btr1"])
    except KeyError:  # reported already
        return None
    except ValueError as error:
        section.refuse_value("btr0", str(error))
        return None


def _timing_of_bitrate(section: Section) -> can.BitTiming | None:
    bitrate: int | None = section.values.get("bitrate")
    sample_point: float | None = section.values.get("sample_point")
    if bitrate is None:
        return None
    if bitrate in can.CAN232_STANDARD_BITRATES and sample_point is None:
        return can.BitTiming(bitrate)
    try:
        can.require_bitrate(bitrate)
    except ValueError as error:
        section.refuse_value("bitrate", str(error))
        return None
    try:
        return can.BitTiming(bitrate, can.bit_timing(bitrate, sample_point))
    except ValueError as error:
        section.refuse_value("bitrate" if sample_point is None else "sample_point", str(error))
        return None


def _read_bus(section: Section | None) -> BusConfig | None:
    if section is None:
        return None
    values = section.read(_BusKeys, unknown_keys=True)
    if "interface" in section.nodes and "interface" not in values:
        return None
    names = key_names(_BusKeys)
    options = {}
    if values.get("interface", "socketcan") == "socketcan":
        section.refuse_unknown(names)
        if text := _interface_name_problem(values.get("channel", "vcan0")):
            section.refuse_value("channel", text)
    else:
        if values.get("create"):
            section.refuse_value("create", "only an interface of socketcan can be created; remove it")
        options = {key: _read_option(section, key) for key in section.nodes if key not in names}
    return BusConfig(**values, options=options) if "channel" in values else None


def _interface_name_problem(name: str) -> str | None:
    """Return what the kernel would not take as the name of an interface (dev_valid_name)."""
    if len(name.encode()) > 15:
        return f"the name of an interface has up to 15 characters, {quoted(name)} has {len(name.encode())}"
    if name in (".", "..") or re.search(r"[/:\s]", name):
        return f"the name of an interface has no '/', ':' or space; {quoted(name)} is none"
    return None


def _read_option(section: Section, key: str) -> Any:
    """Return an option of a python-can interface: a single value, or a list of them."""
    if key in _RESERVED_OPTIONS:
        section.refuse_key(key, f"cannot be given; {_RESERVED_OPTIONS[key]}")
        return None
    if not key.isidentifier():
        section.refuse_key(key, "unknown key; expected the name of an option, such as hop_limit")
        return None
    node = section.nodes[key]
    items: list[Node] = node.value if isinstance(node, SequenceNode) else [node]
    if tag := next(filter(None, map(foreign_tag, (node, *items))), None):
        section.refuse_value(key, f"the YAML tag {tag} means nothing here; remove it")
        return None
    values = [scalar_value(item) for item in items if isinstance(item, ScalarNode)]
    if len(values) < len(items):
        section.refuse_value(key, "expected a single value, or a list of single values")
        return None
    return values if isinstance(node, SequenceNode) else values[0]
