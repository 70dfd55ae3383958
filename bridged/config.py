"""The configuration: a YAML file becomes frozen, typed values, or a list of all that is wrong with it."""

import functools
import os
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from bridged import adapters, can
from bridged.environment import ORIGIN as ENVIRONMENT
from bridged.environment import settings as settings_of
from bridged.environment import variables
from bridged.errors import ConfigError
from bridged.ports.names import PortName
from bridged.settings import (
    AdapterConfig,
    After,
    BusConfig,
    ChannelConfig,
    Config,
    HealthConfig,
    ReconnectConfig,
    Restart,
    TransmitConfig,
)
from bridged.text import quoted
from bridged.yaml_source import (
    COMMAND_LINE,
    Problems,
    Section,
    describe,
    foreign_tag,
    is_empty,
    is_flag,
    key_names,
    parse,
    read_text,
    scalar_value,
)

if TYPE_CHECKING:
    from bridged.overlay import Setting

LONG_DEADLINE_S = 10.0
NOTHING: Mapping[str, str] = {}
# --- The schema ---------------------------------------------------------------------------------
# A description completes "expected …, got the text 'fast'". A new key is: its type and its place in a struct
# here (of one adapter: in adapters/), a value in settings.py, a line in the function that reads the section,
# and its line in config/*.yaml. A reload that changes it reopens the adapter, unless Bridge.reconfigure() can
# go on with it.

Flag = Annotated[bool, Meta(description="true or false")]
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
RestartTime = Annotated[
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
    restart: RestartTime | None = None


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
    "channel": _ChannelKeys,
    "channel.acceptance": _AcceptanceKeys,
    "bus": _BusKeys,
    "transmit": _TransmitKeys,
    "health": _HealthKeys,
    "reconnect": _ReconnectKeys,
}
_TOP = ("adapter", *(path for path in _SECTIONS if "." not in path), "notify")


@functools.cache
def _keys_of_all_adapters() -> type[Struct]:
    """Section `adapter` with every key that any type has. For a file that is wrong: loads all adapters."""
    names = Meta(pattern=f"^({'|'.join(adapters.TYPES)})$", description=" or ".join(adapters.TYPES))
    keys: dict[str, tuple[str, Any] | tuple[str, Any, Any]] = {"type": ("type", Annotated[str, names])}
    for type_ in adapters.TYPES:
        for field in msgspec.structs.fields(adapters.settings_of(type_)):
            required = (field.name, field.type)
            keys.setdefault(field.name, required if field.required else (*required, None))
    return msgspec.defstruct("_AdapterKeys", keys.values(), kw_only=True)


def _schemas() -> dict[str, type[Struct]]:
    return {"adapter": _keys_of_all_adapters(), **_SECTIONS}


_RESERVED_OPTIONS = {
    "bustype": "write interface",
    "receive_own_messages": "the bridge needs it off: it would send frames back to where they came from",
}
"""Keyword arguments of can.Bus that are not for the user."""


def load(path: str | os.PathLike[str], environment: Mapping[str, str] = NOTHING) -> Config:
    """Return the configuration in a file and in environment variables; with these there need be no file.

    ConfigError with all problems, each with line and column.
    """
    return _load(Path(path), environment)[0]


def load_options(options: "Sequence[Setting]", environment: Mapping[str, str] = NOTHING) -> Config:
    """Return the configuration in options of the command line, and in the environment; no file is read.

    It has the name of the interface. ConfigError with all problems, each with its option.
    """
    from bridged.overlay import overlay  # noqa: PLC0415 - as below

    problems = Problems(COMMAND_LINE)
    root = overlay(None, settings_of(environment, problems), problems, ENVIRONMENT)
    root = overlay(root, options, problems, COMMAND_LINE)
    config = _read("", Path(COMMAND_LINE), _top(root, problems))
    return msgspec.structs.replace(config, name=config.bus.channel.replace("/", "-"))


def keys() -> dict[tuple[str, ...], bool]:
    """Every section and every key by its path, and whether it is one of true and false."""
    found: dict[tuple[str, ...], bool] = {(section,): False for section in _TOP}
    for section, schema in _schemas().items():
        for field in msgspec.structs.fields(schema):
            found[(*section.split("."), field.encode_name)] = is_flag(field)
    return found


def check(path: str | os.PathLike[str], environment: Mapping[str, str] = NOTHING) -> tuple[Config, list[str]]:
    """Return what load() does, and a line for each thing that is allowed but probably not meant.

    ConfigError also where python-can lacks what the interface needs, which takes importing it.
    """
    import shutil  # noqa: PLC0415 - 5 ms that `run` need not pay

    config, top = _load(Path(path), environment)
    adapter, transmit = config.adapter, config.transmit
    section = top.section("adapter")
    if section and PortName(adapter.port).is_numbered_terminal:
        text = (
            "the next terminal gets this name when this one ends: use one that stays, as of simulate --link"
        )
        section.warn_key("port", text)
    section = top.section("transmit") if "transmit" in top.nodes else None
    if section and transmit.deadline_s > LONG_DEADLINE_S:
        section.warn_key("deadline", f"a frame may reach the bus {transmit.deadline_s:g} s after it was sent")
    if section and (warning := adapter.window_warning(transmit)):
        section.warn_key("window", warning)
    section = top.section("bus")
    if section and config.bus.create and re.fullmatch(r"can\d+", config.bus.channel):
        text = "a virtual interface of this name is made if there is none, so a real one cannot have it"
        section.warn_key("channel", text)
    if section and config.bus.interface != "socketcan":
        _check_python_can(section, config.bus)
    if config.notify and not shutil.which(config.notify[0]):
        top.warn_key("notify", f"there is no program {quoted(config.notify[0])} here")
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


def _load(file: Path, environment: Mapping[str, str]) -> tuple[Config, Section]:
    problems = Problems(str(file))
    if variables(environment) and _is_missing(file):
        root = None
        only = [f"{file}: there is no such file: the environment is all there is"]
    else:
        root = parse(read_text(file, problems), problems)
        only = []
    if variables(environment):
        from bridged.overlay import overlay  # noqa: PLC0415 - a file alone does without

        root = overlay(root, settings_of(environment, problems), problems, ENVIRONMENT)
    try:
        top = _top(root, problems)
        return _read(file.stem, file, top), top
    except ConfigError as error:
        raise ConfigError([*only, *error.problems]) from None


def _top(root: Node | None, problems: Problems) -> Section:
    """The document, if it is a mapping."""
    if not isinstance(root, MappingNode) or foreign_tag(root):
        empty = root is None or is_empty(root)
        what = "the file is empty" if empty else "the file is no mapping (a 'key: value' in each line)"
        line, column = (0, 0) if root is None else (root.start_mark.line, root.start_mark.column)
        problems.add(line, column, f"{what}; expected sections adapter, channel and bus")
        raise problems.error()
    return Section(root, _schemas, problems)


def _is_missing(file: Path) -> bool:
    try:
        file.stat()
    except FileNotFoundError:
        return True
    except OSError:  # reading says why
        pass
    return False


def _read(name: str, path: Path, top: Section) -> Config:
    """The configuration; ConfigError with all problems."""
    top.refuse_unknown(list(_TOP))
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
    notify = _read_command(top, "notify")
    if top.problems or not (adapter and channel and bus and transmit and health and reconnect):
        raise top.problems.error()
    return Config(
        name=name,
        path=path,
        adapter=adapter,
        channel=channel,
        bus=bus,
        transmit=transmit,
        health=health,
        reconnect=reconnect,
        notify=notify,
    )


_S = TypeVar("_S", bound=Struct)


def _read_plain(section: Section | None, schema: type[Struct], settings: type[_S]) -> _S | None:
    """Read a section in which every key stands for itself; None, reported, if one is missing or wrong."""
    if section is None:
        return None
    values = section.read(schema)
    complete = all(field.name in values or not field.required for field in msgspec.structs.fields(schema))
    return settings(**values) if complete else None


def _read_adapter(section: Section | None) -> AdapterConfig | None:
    if section is None:
        return None
    type_ = _adapter_type(section)
    if type_ is None:
        section.read(_keys_of_all_adapters())
        if text := PortName(section.values.get("port", "/")).problem():
            section.refuse_value("port", text)
        return None
    settings = adapters.settings_of(type_)
    if not section.keys.keys() <= set(key_names(settings)):
        _refuse_keys_of_others(section, settings, type_)
    adapter = _read_plain(section, settings, settings)
    port = PortName(section.values.get("port", "/"))
    if text := port.problem(settings.schemes, settings.refused_schemes):
        section.refuse_value("port", text)
    if settings.identified_by_usb:
        _check_usb_serial_number(section, port)
    for key, text in settings.problems(section.values, section.nodes):
        section.refuse_value(key, text)
    return adapter


def _adapter_type(section: Section) -> str | None:
    """The type of the adapter, also of one that is meant by another name; None if it is none."""
    node = section.nodes.get("type")
    if not isinstance(node, ScalarNode):
        return None
    if node.value in adapters.TYPES:
        return str(node.value)
    for type_ in adapters.TYPES:
        settings = adapters.settings_of(type_)
        if node.value.lower() in settings.other_names:
            section.refuse_value("type", settings.other_names_advice.format(quoted(node.value)))
            node.value = type_  # for the other keys
            return type_
    return None


def _refuse_keys_of_others(section: Section, settings: type[AdapterConfig], type_: str) -> None:
    """Report keys that only other types of adapter have. Loads all adapters."""
    own = key_names(settings)
    for key in [key for key in section.keys if key not in own]:
        homes = [
            other
            for other in adapters.TYPES
            if other != type_ and key in key_names(adapters.settings_of(other))
        ]
        if homes:
            default = f"goes with type: {' or '.join(homes)}; remove it"
            section.refuse_key(key, settings.refused_keys.get(key, default))
            del section.keys[key]  # or it would be reported as unknown too


def _check_usb_serial_number(section: Section, port: PortName) -> None:
    """Report one that could not be kept to: the device itself does not tell it, only USB knows it."""
    serial_number = section.values.get("serial_number")
    if serial_number is None:
        return
    if port.scheme == "socket":
        section.refuse_key("serial_number", "is the USB device's, unknown through socket://; remove it")
    if port.serial_number is not None and port.serial_number != serial_number:
        other = f"is not the one in port, {quoted(port.serial_number)}"
        section.refuse_value("serial_number", f"{quoted(serial_number)} {other}; remove one of them")


def _read_transmit(section: Section | None, adapter: AdapterConfig | None) -> TransmitConfig | None:
    """Read `transmit`; without the section, and for what it leaves out, its defaults."""
    keys = _read_plain(section, _TransmitKeys, _TransmitKeys) or _TransmitKeys()
    if adapter is None:
        return None
    window = adapter.default_window if keys.window is None else keys.window
    transmit = TransmitConfig(queue=keys.queue, window=window, deadline_s=keys.deadline_s)
    if section and (text := adapter.window_problem(transmit)):
        section.refuse_value("window", text)
    return transmit


def _read_reconnect(top: Section) -> ReconnectConfig | None:
    if "reconnect" not in top.nodes:
        return ReconnectConfig()
    section = top.section("reconnect", required=False)
    reconnect = _read_plain(section, _ReconnectKeys, ReconnectConfig)
    if section and reconnect and reconnect.initial_s > reconnect.maximum_s:
        text = f"initial ({reconnect.initial_s:g} s) is more than maximum ({reconnect.maximum_s:g} s)"
        section.refuse_value("maximum" if "maximum" in section.nodes else "initial", text)
    return reconnect


def _read_command(top: Section, key: str) -> tuple[str, ...]:
    """Read a command and its arguments, a list; empty without it, and where that is wrong."""
    node = top.nodes.get(key)
    if node is None:
        return ()
    words = node.value if isinstance(node, SequenceNode) else []
    texts = tuple(word.value for word in words if isinstance(word, ScalarNode) and not foreign_tag(word))
    if texts and len(texts) == len(words) and texts[0] and all(map(str.isprintable, texts)):
        return texts
    got = "nothing" if is_empty(node) else "another list" if words else describe(node)
    wanted = "a list with a command and its arguments, such as [/usr/local/bin/tell, pc]"
    top.refuse_value(key, f"expected {wanted}, got {got}")
    return ()


def _read_channel(section: Section | None, adapter: AdapterConfig | None) -> ChannelConfig | None:
    if section is None:
        return None
    values = section.read(_ChannelKeys)
    timing = _read_timing(section, adapter.bitrates if adapter else can.STANDARD_REGISTERS)
    acceptance = None
    if "acceptance" in section.nodes and (
        keys := _read_plain(section.section("acceptance", required=False), _AcceptanceKeys, _AcceptanceKeys)
    ):
        acceptance = can.AcceptanceFilter(keys.code, keys.mask, single=keys.mode == "single")
    if timing is None or adapter is None:
        return None
    milliseconds: int | str | None = values.get("restart")
    restart = adapter.default_restart
    if milliseconds is not None:
        restart = After(milliseconds / 1000) if isinstance(milliseconds, int) else Restart.NEVER
    return ChannelConfig(
        timing=timing,
        listen_only=values.get("listen_only", False),
        acceptance=acceptance,
        restart=restart,
    )


def _read_timing(section: Section, bitrates: Collection[int]) -> can.BitTiming | None:
    """Make the bit timing of `bitrate` (and `sample_point`), or of `btr0` and `btr1`."""
    registers = [key for key in ("btr0", "btr1") if key in section.nodes]
    if "bitrate" in section.nodes:
        if registers:
            section.refuse_key(registers[0], "excludes bitrate; give bitrate, or btr0 and btr1")
            return None
        return _timing_of_bitrate(section, bitrates)
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


def _timing_of_bitrate(section: Section, bitrates: Collection[int]) -> can.BitTiming | None:
    bitrate: int | None = section.values.get("bitrate")
    sample_point: float | None = section.values.get("sample_point")
    if bitrate is None:
        return None
    if bitrate in bitrates and sample_point is None:
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
