"""bridged.config: what loads, and for what does not, the exact list of problems."""
# ruff: noqa: E501 - in the tables, a message is one line as the user sees it

from __future__ import annotations

import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import msgspec
import pytest

from bridged import config
from bridged.adapters import TYPES, settings_of
from bridged.adapters.can232 import Can232Config
from bridged.adapters.usb2can import Usb2canConfig
from bridged.can import AcceptanceFilter, BitTiming
from bridged.config import load
from bridged.errors import ConfigError
from bridged.settings import After, BusConfig, ChannelConfig, Config, ReconnectConfig, Restart, TransmitConfig
from bridged.yaml_source import key_names

TYPE_NAMES = " or ".join(TYPES)

if TYPE_CHECKING:
    from collections.abc import Callable

with warnings.catch_warnings(action="ignore"):  # python-can 4.1 on Python 3.11
    import can as python_can

REPOSITORY = Path(__file__).parents[2]
EXAMPLES = sorted((REPOSITORY / "config").glob("*.yaml"))

ISSUE = """\
adapter:
  type: can232
  port: /dev/ttyUSB0
  baudrate: 57600
  serial_number: A123
channel:
  bitrate: 125000
  listen_only: false
  acceptance: {code: 0x00006000, mask: 0x00001FF0, mode: dual}
bus:
  interface: socketcan
  channel: vcan0
  create: true
transmit: {queue: 1024, window: 1, deadline: 1.0}
"""

needs_calculator = pytest.mark.skipif(
    not hasattr(python_can.BitTiming, "iterate_from_sample_point"), reason="python-can older than 4.3"
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "test.yaml"


def four_lines(
    adapter: str = "{type: can232, port: /dev/ttyUSB0}",
    channel: str = "{bitrate: 125000}",
    bus: str = "{channel: vcan0}",
    more: str = "",
) -> str:
    """A file with a section in each line; their values begin in columns 10, 10, 6 and 11 (transmit)."""
    return f"adapter: {adapter}\nchannel: {channel}\nbus: {bus}\n{more}\n"


def adapter(extra: str) -> str:
    return four_lines(f"{{type: can232, port: /dev/x, {extra}}}")


def port(text: str) -> str:
    return four_lines(f"{{type: can232, port: {text}}}")


def usb2can(extra: str) -> str:
    return four_lines(f"{{type: usb2can, port: /dev/x, {extra}}}")


def usb2can_port(text: str) -> str:
    return four_lines(f"{{type: usb2can, port: {text}}}")


def channel(keys: str) -> str:
    return four_lines(channel=f"{{{keys}}}")


def bus(keys: str) -> str:
    return four_lines(bus=f"{{{keys}}}")


def transmit(keys: str) -> str:
    return four_lines(more=f"transmit: {{{keys}}}")


def reconnect(keys: str) -> str:
    return four_lines(more=f"reconnect: {{{keys}}}")


def problems_of(file: Path, content: str | bytes) -> list[str]:
    """The problems of a file, without its name; none if it loads."""
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    problems = []
    try:
        load(file)
    except ConfigError as error:
        problems = error.problems
    assert all(problem.startswith(f"{file}:") for problem in problems)
    return [problem.removeprefix(f"{file}:") for problem in problems]


# --- What loads ------------------------------------------------------------------------------------


def test_the_whole_schema(file: Path) -> None:
    file.write_text(ISSUE)
    loaded = load(str(file))
    assert loaded == Config(
        name="test",
        path=file,
        adapter=Can232Config(type="can232", port="/dev/ttyUSB0", baudrate=57_600, serial_number="A123"),
        channel=ChannelConfig(
            timing=BitTiming(125_000),
            listen_only=False,
            acceptance=AcceptanceFilter(0x6000, 0x1FF0, False),
            restart=After(0.1),
        ),
        bus=BusConfig(interface="socketcan", channel="vcan0", create=True, options={}),
        transmit=TransmitConfig(queue=1024, window=1, deadline_s=1.0),
    )
    with pytest.raises(AttributeError):
        loaded.adapter.port = "/dev/null"  # type: ignore[misc]


def test_defaults(file: Path) -> None:
    file.write_text(four_lines())
    loaded = load(file)
    assert loaded.adapter == Can232Config(
        type="can232", port="/dev/ttyUSB0", baudrate=57_600, serial_number=None
    )
    assert loaded.channel == ChannelConfig(
        timing=BitTiming(125_000), listen_only=False, acceptance=None, restart=After(0.1)
    )
    assert loaded.bus == BusConfig(interface="socketcan", channel="vcan0", create=False, options={})
    assert loaded.transmit == TransmitConfig(queue=1024, window=1, deadline_s=1.0)


@pytest.mark.parametrize(
    ("adapter", "keys", "restart"),
    [
        ("{type: can232, port: /dev/x}", ", restart: 1", After(0.001)),
        ("{type: can232, port: /dev/x}", ", restart: never", Restart.NEVER),
        ("{type: usb2can, port: /dev/x}", "", Restart.ITSELF),
        ("{type: usb2can, port: /dev/x}", ", restart: 60000", After(60.0)),
        ("{type: usb2can, port: /dev/x}", ", restart: 'never'", Restart.NEVER),
    ],
)
def test_restart(file: Path, adapter: str, keys: str, restart: Restart | After) -> None:
    file.write_text(four_lines(adapter, channel=f"{{bitrate: 125000{keys}}}"))
    assert load(file).channel.restart == restart


def test_usb2can(file: Path) -> None:
    port = "usb://0403:6001/A6008isP"
    keys = "serial_number: A6008isP, critical_limit: 18, ready_limit: 17"
    file.write_text(four_lines(f"{{type: usb2can, port: '{port}', {keys}}}", more="transmit: {window: 1}"))
    loaded = load(file)
    assert loaded.adapter == Usb2canConfig(
        type="usb2can", port=port, serial_number="A6008isP", critical_limit=18, ready_limit=17
    )
    assert loaded.transmit == TransmitConfig(queue=1024, window=1, deadline_s=1.0)


@pytest.mark.parametrize("more", ["", "transmit: {}", "transmit: {deadline: 1}"])
def test_defaults_of_usb2can(file: Path, more: str) -> None:
    """The limits that a public client found to work, and more frames ahead: no answer to wait for."""
    file.write_text(four_lines("{type: usb2can, port: /dev/ttyUSB0}", more=more))
    loaded = load(file)
    assert loaded.adapter == Usb2canConfig(
        type="usb2can", port="/dev/ttyUSB0", serial_number=None, critical_limit=15, ready_limit=7
    )
    assert loaded.transmit == TransmitConfig(queue=1024, window=16, deadline_s=1.0)


def test_the_type_tells_the_adapters_apart(file: Path) -> None:
    file.write_text(four_lines("{port: /dev/x, type: !!str usb2can}"))
    assert isinstance(load(file).adapter, Usb2canConfig)
    file.write_text(four_lines("{port: /dev/x, type: 'can232'}"))
    assert isinstance(load(file).adapter, Can232Config)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.name)
def test_examples_load(example: Path) -> None:
    assert load(example).name == example.stem


def test_there_are_examples() -> None:
    assert {"can232", "usb2can"} <= {example.stem for example in EXAMPLES}


@pytest.mark.parametrize("type_", ["can232", "usb2can"])
def test_the_examples_show_every_key_and_the_defaults(file: Path, type_: str) -> None:
    text = (REPOSITORY / "config" / f"{type_}.yaml").read_text()
    sections = {**config._SECTIONS, "adapter": settings_of(type_)}
    for section, schema in sections.items():
        for key in key_names(schema):
            shows = re.search(rf"^ +(# )?({key}: |acceptance: .*\b{key}: )", text, re.MULTILINE)
            assert shows, f"config/{type_}.yaml has no line, or comment, for {key} of {section}"
    for key in config._TOP:
        assert re.search(rf"^(# )?{key}:", text, re.MULTILINE), f"config/{type_}.yaml: {key}?"
    shown = load(REPOSITORY / "config" / f"{type_}.yaml")
    file.write_text(four_lines(f"{{type: {type_}, port: /dev/ttyUSB0}}"))
    defaults = load(file)
    assert (shown.adapter, shown.transmit) == (defaults.adapter, defaults.transmit)
    assert (shown.health, shown.reconnect) == (defaults.health, defaults.reconnect)


@needs_calculator
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.name)
def test_what_an_example_has_in_comments_is_right_too(file: Path, example: Path) -> None:
    text = example.read_text()
    for comment in re.findall(r"^  # \w+: .*\n", text, re.MULTILINE):
        line = comment.replace("# ", "", 1)
        key = line.split(":")[0].strip()
        if key not in ("btr0", "btr1"):  # go together, without bitrate
            others = re.sub(rf"^  {key}: .*\n", "", text, flags=re.MULTILINE)
            assert problems_of(file, others.replace(comment, line)) == [], line


@pytest.mark.parametrize(
    ("text", "path", "value"),
    [
        (adapter("serial_number: 0123"), "adapter.serial_number", "0123"),
        (adapter("serial_number: 1E5"), "adapter.serial_number", "1E5"),
        (adapter("serial_number: 1.0E+5"), "adapter.serial_number", "1.0E+5"),
        (adapter("serial_number: 12:30"), "adapter.serial_number", "12:30"),
        (adapter("serial_number: no"), "adapter.serial_number", "no"),
        (adapter("serial_number: 2026-01-02"), "adapter.serial_number", "2026-01-02"),
        (adapter("baudrate: 115_200"), "adapter.baudrate", 115_200),
        (adapter("baudrate: !!int 9600"), "adapter.baudrate", 9600),
        (port("'socket://[::1]:4001'"), "adapter.port", "socket://[::1]:4001"),
        (port("'rfc2217://nas.local:1?timeout=3'"), "adapter.port", "rfc2217://nas.local:1?timeout=3"),
        (usb2can_port("'socket://[::1]:4001'"), "adapter.port", "socket://[::1]:4001"),
        (usb2can_port("usb://0403:6001"), "adapter.port", "usb://0403:6001"),
        (usb2can_port("usb://0403:FaFa/A/1:2"), "adapter.port", "usb://0403:FaFa/A/1:2"),
        (usb2can_port("usb://0403:6001, serial_number: 0123"), "adapter.serial_number", "0123"),
        (usb2can_port("usb://0403:6001/1E5, serial_number: 1E5"), "adapter.serial_number", "1E5"),
        (usb2can_port("usb://0403:6001/1E5"), "adapter.serial_number", None),
        (usb2can("critical_limit: 8"), "adapter.critical_limit", 8),
        (usb2can("critical_limit: 2, ready_limit: 1"), "adapter.critical_limit", 2),
        (usb2can("ready_limit: 14"), "adapter.ready_limit", 14),
        (usb2can("ready_limit: 17, critical_limit: 0x12"), "adapter.critical_limit", 18),
        (four_lines("{type: usb2can, port: /dev/x}", more="transmit: {window: 32, deadline: 0.001}"), "transmit.window", 32),
        (channel("bitrate: 800000"), "channel.timing", BitTiming(800_000)),
        (channel("btr0: 0x03, btr1: 28"), "channel.timing", BitTiming(125_000, (0x03, 0x1C))),
        (channel("btr0: 0b11, btr1: 0x1c"), "channel.timing", BitTiming(125_000, (0x03, 0x1C))),
        (channel("btr0: 0x3F, btr1: 0x7F"), "channel.timing", BitTiming(5_000, (0x3F, 0x7F))),
        (channel("btr0: &r 0x14, btr1: *r"), "channel.timing", BitTiming(47_619, (0x14, 0x14))),
        (channel("bitrate: 10000, listen_only: yes"), "channel.listen_only", True),
        (channel("bitrate: 10000, listen_only: Off"), "channel.listen_only", False),
        (channel("bitrate: 10000, acceptance: {code: 0, mask: 0xFFFFFFFF, mode: single}"), "channel.acceptance", AcceptanceFilter(0, 0xFFFFFFFF, single=True)),
        (bus("channel: 0"), "bus.channel", "0"),
        (bus("channel: a23456789012345"), "bus.channel", "a23456789012345"),
        (bus("interface: virtual, channel: a/b c d e f g h i"), "bus.channel", "a/b c d e f g h i"),
        (bus("interface: virtual, channel: x, create: false"), "bus.create", False),
        (bus("interface: pcan, channel: x, a: 1, b: 0.5, c: yes, d: e f, g: [1, x], h: ~, i: []"), "bus.options", {"a": 1, "b": 0.5, "c": True, "d": "e f", "g": [1, "x"], "h": None, "i": []}),
        (transmit("deadline: 1"), "transmit.deadline_s", 1.0),
        (transmit("deadline: 3600, window: 32"), "transmit.window", 32),
        (transmit(""), "transmit.queue", 1024),
        (four_lines(), "reconnect.maximum_s", 5.0),
        (reconnect("maximum: 0.1"), "reconnect", ReconnectConfig(initial_s=0.1, maximum_s=0.1)),
        (reconnect("initial: 0.01, maximum: 3600"), "reconnect", ReconnectConfig(initial_s=0.01, maximum_s=3600.0)),
        ("\ufeff" + four_lines(), "name", "test"),
        (four_lines().replace("\n", "\r\n"), "adapter.port", "/dev/ttyUSB0"),
        ("%YAML 1.1\n---\n" + four_lines(), "name", "test"),
    ],
)  # fmt: skip
def test_values(file: Path, text: str, path: str, value: object) -> None:
    file.write_bytes(text.encode())
    found: Any = load(file)
    for name in path.split("."):
        found = getattr(found, name)
    assert found == value
    assert type(found) is type(value)


@needs_calculator
@pytest.mark.parametrize(
    ("channel", "timing"),
    [
        ("{bitrate: 83333}", BitTiming(83_333, (0x45, 0x1C))),
        ("{bitrate: 125000, sample_point: 0.75}", BitTiming(125_000, (0xC3, 0x3A))),
        ("{bitrate: 125000, sample_point: 0.875}", BitTiming(125_000, (0x43, 0x1C))),
    ],
)
def test_bit_timing_by_python_can(file: Path, channel: str, timing: BitTiming) -> None:
    file.write_text(four_lines(channel=channel))
    assert load(file).channel.timing == timing


# --- What does not ---------------------------------------------------------------------------------

PORT = "expected a device path like /dev/ttyUSB0 or a URL like socket://HOST:PORT"
URL = "HOST:PORT with a PORT from 1 to 65535, got"
BAUDRATE = "expected a UART rate from 50 to 4000000 bit/s"
BITRATE = "expected a bit rate from 10000 to 1000000 bit/s (a slower one by btr0 and btr1)"
REGISTER = "expected a register value from 0x00 to 0xFF"
RESTART = "expected a number of milliseconds from 1 to 60000, or never"
SAMPLE_POINT = "expected a fraction of the bit time from 0.5 to 0.95"
WORD = "expected a number from 0x00000000 to 0xFFFFFFFF"
NAME = "the name of an interface has"
PAUSE = "expected a number of seconds from 0.01 to 3600"
DEADLINE = "expected a number of seconds above 0 and up to 3600"
USB = "expected usb://VID:PID or usb://VID:PID/SERIAL, VID and PID as 4 hex digits each, got"
CRITICAL = "expected a number of frames from 2 to 18"
READY = "expected a number of frames from 1 to 17"
SERIAL_NUMBER = "expected the serial number that the device reports"
SINGLE = "expected a single value, or a list of single values"


@pytest.mark.parametrize(
    ("section", "entry", "problem"),
    [
        (port, "ttyUSB0", "a device path begins with '/', such as /dev/ttyUSB0; 'ttyUSB0' does not"),
        (port, "3", "a device path begins with '/', such as /dev/ttyUSB0; '3' does not"),
        (port, "''", f"{PORT}, got the text ''"),
        (port, "{a: b}", f"{PORT}, got a mapping"),
        (port, '"/dev/\\0"', f"{PORT}, without unprintable characters"),
        (port, '"/dev/\\ud800"', f"{PORT}, without unprintable characters"),
        (port, "loop://", "the URL of a port begins with socket://, rfc2217:// or usb-serial://, not 'loop://'"),
        (port, "socket://host", f"expected socket://{URL} 'socket://host'"),
        (port, "socket://host:0", f"expected socket://{URL} 'socket://host:0'"),
        (port, "rfc2217://host:65536", f"expected rfc2217://{URL} 'rfc2217://host:65536'"),
        (port, "socket://:4001", f"expected socket://{URL} 'socket://:4001'"),
        (port, "socket://a..b:1", f"expected socket://{URL} 'socket://a..b:1'"),
        (port, "socket://größe:1", f"expected socket://{URL} 'socket://größe:1'"),
        (adapter, "baudrate: fast", f"{BAUDRATE}, got the text 'fast'"),
        (adapter, "baudrate: 1e6", f"{BAUDRATE}, got the text '1e6' (write 1000000)"),
        (adapter, "baudrate: '57600'", f"{BAUDRATE}, got the text '57600' (write 57600, without quotes)"),
        (adapter, "baudrate: !!str 9600", f"{BAUDRATE}, got the text '9600' (write 9600)"),
        (adapter, "baudrate: 057600", f"{BAUDRATE}, got the text '057600' (write 57600)"),
        (adapter, "baudrate: 0o17", f"{BAUDRATE}, got the text '0o17' (write 15)"),
        (adapter, "baudrate: 12:30", f"{BAUDRATE}, got the text '12:30'"),
        (adapter, "baudrate: 57600.0", f"{BAUDRATE}, got 57600.0"),
        (adapter, "baudrate: yes", f"{BAUDRATE}, got the yes-or-no value 'yes'"),
        (adapter, "baudrate: 2026-01-02", f"{BAUDRATE}, got the text '2026-01-02'"),
        (adapter, "baudrate: 49", f"{BAUDRATE}, got 49"),
        (adapter, "baudrate: -9600", f"{BAUDRATE}, got -9600"),
        (adapter, "baudrate: 1" + "0" * 50, f"{BAUDRATE}, got 1{'0' * 39}…"),
        (adapter, "baudrate: " + "9" * 5000, f"{BAUDRATE}, got the text '{'9' * 40}…'"),
        (adapter, "baudrate: !!int x", f"{BAUDRATE}, got the text 'x'"),
        (adapter, "baudrate: !!bool x", f"{BAUDRATE}, got the text 'x'"),
        (adapter, "baudrate: !!binary aGk=", "the YAML tag '!!binary' means nothing here; remove it"),
        (adapter, "baudrate: null", f"is empty; {BAUDRATE}, or remove the key"),
        (adapter, "serial_number: A 1", f"{SERIAL_NUMBER}, got the text 'A 1'"),
        (port, "usb://0403:6001", "usb:// goes with type: usb2can; a CAN232 is on a serial line, such as /dev/ttyUSB0"),
        (port, "usb://", "usb:// goes with type: usb2can; a CAN232 is on a serial line, such as /dev/ttyUSB0"),
        (usb2can_port, "ttyUSB0", "a device path begins with '/', such as /dev/ttyUSB0; 'ttyUSB0' does not"),
        (usb2can_port, "usb:0403:6001", "a URL has '//' behind the colon: usb://0403:6001"),
        (usb2can_port, "rfc2217://host:4001", "rfc2217:// sets the baud rate of a serial line, and a USB2CAN has none; write socket://"),
        (usb2can_port, "USB://0403:6001", "the URL of a port begins with socket://, usb:// or usb-serial://, not 'USB://'"),
        (usb2can_port, "socket://host", f"expected socket://{URL} 'socket://host'"),
        (usb2can_port, "usb://", f"{USB} 'usb://'"),
        (usb2can_port, "usb://403:6001", f"{USB} 'usb://403:6001'"),
        (usb2can_port, "usb://0x0403:0x6001", f"{USB} 'usb://0x0403:0x6001'"),
        (usb2can_port, "usb://0403:600g", f"{USB} 'usb://0403:600g'"),
        (usb2can_port, "usb://0403:6001/", f"{USB} 'usb://0403:6001/'"),
        (usb2can_port, "usb://0403:6001/A B", f"{USB} 'usb://0403:6001/A B'"),
        (usb2can_port, "usb://0403:6001/ö", f"{USB} 'usb://0403:6001/ö'"),
        (usb2can_port, "usb://٠٤٠٣:6001", f"{USB} 'usb://٠٤٠٣:6001'"),
        (usb2can_port, "usb://0403:6001/" + "A" * 33, f"{USB} 'usb://0403:6001/{'A' * 24}…'"),
        (usb2can, "serial_number: A 1", f"{SERIAL_NUMBER}, got the text 'A 1'"),
        (usb2can, "critical_limit: 1", f"{CRITICAL}, got 1"),
        (usb2can, "critical_limit: 19", f"{CRITICAL}, got 19"),
        (usb2can, "ready_limit: 16, critical_limit: 15.5", f"{CRITICAL}, got 15.5"),
        (usb2can, "critical_limit: 2, ready_limit: 18", f"{READY}, got 18"),
        (usb2can, "ready_limit: 0", f"{READY}, got 0"),
        (usb2can, "ready_limit: off", f"{READY}, got the yes-or-no value 'off'"),
        (usb2can, "ready_limit: null", f"is empty; {READY}, or remove the key"),
        (usb2can, "critical_limit: 7", "expected a limit above ready_limit (7, its default), got 7"),
        (usb2can, "ready_limit: 15", "expected a limit below critical_limit (15, its default), got 15"),
        (usb2can, "critical_limit: 0x0A, ready_limit: 10", "expected a limit below critical_limit (10), got 10"),
        (channel, "bitrate: 123456", "123456 bit/s cannot be reached with the adapter's 16 MHz clock; nearest is 123077 bit/s; or give btr0 and btr1"),
        (channel, "bitrate: 2000000", f"{BITRATE}, got 2000000"),
        (channel, "bitrate: 5000", f"{BITRATE}, got 5000"),
        (channel, "bitrate: 125k", f"{BITRATE}, got the text '125k'"),
        (channel, "btr1: 0x11, btr0: 0", "btr0 0x00 with btr1 0x11 makes 1600000 bit/s; CAN ends at 1000000"),
        (channel, "btr1: 0x1C, btr0: 0x100", f"{REGISTER}, got 0x100"),
        (channel, "btr0: 0x03, btr1: 1C", f"{REGISTER}, got the text '1C'"),
        (channel, "bitrate: 125000, sample_point: 87.5", f"{SAMPLE_POINT}, got 87.5"),
        (channel, "bitrate: 125000, sample_point: .nan", f"{SAMPLE_POINT}, got the text '.nan'"),
        (channel, "bitrate: 125000, listen_only: 1", "expected true or false, got 1"),
        (channel, "bitrate: 125000, restart: 0", f"{RESTART}, got 0"),
        (channel, "bitrate: 125000, restart: 60001", f"{RESTART}, got 60001"),
        (channel, "bitrate: 125000, restart: 1.5", f"{RESTART}, got 1.5"),
        (channel, "bitrate: 125000, restart: off", f"{RESTART}, got the yes-or-no value 'off'"),
        (channel, "bitrate: 125000, restart: 100 ms", f"{RESTART}, got the text '100 ms'"),
        (channel, "bitrate: 125000, acceptance: 3", "expected a section with code, mask, got 3"),
        (bus, "channel: a234567890123456", f"{NAME} up to 15 characters, 'a234567890123456' has 16"),
        (bus, "channel: größe-größe-1", f"{NAME} up to 15 characters, 'größe-größe-1' has 17"),
        (bus, "channel: /dev/can", f"{NAME} no '/', ':' or space; '/dev/can' is none"),
        (bus, "channel: ..", f"{NAME} no '/', ':' or space; '..' is none"),
        (bus, "channel: x, interface: a b", "expected socketcan or the name of another python-can interface, got the text 'a b'"),
        (bus, "interface: virtual, channel: x, create: yes", "only an interface of socketcan can be created; remove it"),
        (transmit, "window: 33", "expected a number of unanswered frames from 1 to 32, got 33"),
        (transmit, "deadline: 0", f"{DEADLINE}, got 0"),
        (transmit, "deadline: .inf", f"{DEADLINE}, got the text '.inf'"),
        (transmit, "deadline: 1e-1", f"{DEADLINE}, got the text '1e-1' (write 0.1)"),
        (transmit, "deadline: 1e-9", f"{DEADLINE}, got the text '1e-9'"),
        (transmit, "deadline: 1:30.5", f"{DEADLINE}, got the text '1:30.5'"),
        (reconnect, "maximum: 0", f"{PAUSE}, got 0"),
        (reconnect, "initial: 3601", f"{PAUSE}, got 3601"),
        (reconnect, "initial: 5.1", "initial (5.1 s) is more than maximum (5 s)"),
        (reconnect, "initial: 2, maximum: 1", "initial (2 s) is more than maximum (1 s)"),
    ],
)  # fmt: skip
def test_one_wrong_value(file: Path, section: Callable[[str], str], entry: str, problem: str) -> None:
    """The last value of the entry is wrong, and only that."""
    text = section(entry)
    if section in (port, usb2can_port):
        entry = f"port: {entry}"
    name = section.__name__ if section in (channel, bus, transmit, reconnect) else "adapter"
    path = f"{name}.{entry.rpartition(', ')[2]}"
    key, value = path.split(": ", 1)
    line = next(number for number, line in enumerate(text.splitlines()) if entry in line)
    column = text.splitlines()[line].rindex(value)
    assert problems_of(file, text) == [f"{line + 1}:{column + 1}: {key}: {problem}"]


ADAPTER_KEYS = "type, port, baudrate, serial_number, firmware, critical_limit, ready_limit"
CAN232_KEYS = "type, port, baudrate, serial_number, firmware"
USB2CAN_KEYS = "type, port, serial_number, critical_limit, ready_limit"
CHANNEL_KEYS = "bitrate, btr0, btr1, sample_point, listen_only, acceptance, restart"
BUS_KEYS = "interface, channel, create"
SECTIONS = "expected sections adapter, channel and bus"
NO_MAPPING = f"the file is no mapping (a 'key: value' in each line); {SECTIONS}"

CASES: dict[str, tuple[str | bytes, list[str]]] = {
    # the file
    "empty": ("", [f"1:1: the file is empty; {SECTIONS}"]),
    "comment": ("# nothing\n", [f"1:1: the file is empty; {SECTIONS}"]),
    "null": ("\n---\n", [f"3:1: the file is empty; {SECTIONS}"]),
    "list": ("\n- a\n", [f"2:1: {NO_MAPPING}"]),
    "text": ("hello", [f"1:1: {NO_MAPPING}"]),
    "tagged": ("!!set {a, b}", [f"1:1: {NO_MAPPING}"]),
    "window for a slow line": (
        "adapter: {type: can232, port: /dev/ttyS0, baudrate: 2400}\nchannel: {bitrate: 125000}\n"
        "bus: {channel: vcan0}\ntransmit: {window: 32}\n",
        ["4:20: transmit.window: 32 frames take 3.6 s at 2400 Bd, more than half of the deadline of 1 s, "
         "so they could be sent late; at most 4"],
    ),
    "no sections": ("{}", [
        "1:1: adapter: is missing; expected a section with type, port",
        f"1:1: channel: is missing; expected a section with {CHANNEL_KEYS}",
        "1:1: bus: is missing; expected a section with channel",
    ]),
    "sections that are none": ("adapter: can232\nchannel: [1]\nbus:\ntransmit: ~\n", [
        "1:10: adapter: expected a section with type, port, got the text 'can232'",
        f"2:10: channel: expected a section with {CHANNEL_KEYS}, got a list",
        "3:5: bus: is empty; expected a section with channel",
        "4:11: transmit: is empty; expected a section with queue, window, deadline, or remove the key",
    ]),
    "empty sections": ("adapter: {}\nchannel: {}\nbus: {}\n", [
        f"1:1: adapter.type: is missing; expected {TYPE_NAMES}",
        f"1:1: adapter.port: is missing; {PORT}",
        "2:1: channel.bitrate: is missing; expected a bit rate in bit/s (or btr0 and btr1)",
        "3:1: bus.channel: is missing; expected the name of an interface",
    ]),
    # keys
    "unknown": ("adapter:\n  type: can232\n  port: /dev/x\n  baud: 1\nchannel: {bitrate: 125000}\nbus: {channel: vcan0, loop: true}\ntransmitt: {}\n1: 2\n", [
        f"4:3: adapter.baud: unknown key, baudrate is probably meant; allowed here: {CAN232_KEYS}",
        f"6:23: bus.loop: unknown key; allowed here: {BUS_KEYS}",
        "7:1: transmitt: unknown key, transmit is probably meant; allowed here: adapter, channel, bus, transmit, health, reconnect, notify",
        "8:1: 1: unknown key; allowed here: adapter, channel, bus, transmit, health, reconnect, notify",
    ]),
    "in the wrong section": ("adapter: {type: can232, port: /dev/x, bitrate: 1, channel: a}\nchannel: {bitrate: 125000, mask: 1}\nbus: {channel: vcan0}\nport: /dev/x\n", [
        f"1:39: adapter.bitrate: unknown key, it belongs to channel; allowed here: {CAN232_KEYS}",
        f"1:51: adapter.channel: unknown key, it belongs to bus; allowed here: {CAN232_KEYS}",
        f"2:28: channel.mask: unknown key, it belongs to channel.acceptance; allowed here: {CHANNEL_KEYS}",
        "4:1: port: unknown key, it belongs to adapter; allowed here: adapter, channel, bus, transmit, health, reconnect, notify",
    ]),
    "hyphen, capitals": (channel("bitrate: 125000, listen-only: true, BTR0: 3"), [
        f"2:28: channel.listen-only: unknown key, listen_only is probably meant; allowed here: {CHANNEL_KEYS}",
        f"2:47: channel.BTR0: unknown key, btr0 is probably meant; allowed here: {CHANNEL_KEYS}",
    ]),
    "odd keys": (bus("channel: vcan0, ? [a] : 1, ? {b: c} : 2, 'a b': 3, \"\\n\": 4, " + "x" * 50 + ": 5"), [
        "3:25: bus: a key is a single word",
        "3:36: bus: a key is a single word",
        f"3:48: bus.'a b': unknown key; allowed here: {BUS_KEYS}",
        f"3:58: bus.'\\n': unknown key; allowed here: {BUS_KEYS}",
        f"3:67: bus.'{'x' * 40}…': unknown key; allowed here: {BUS_KEYS}",
    ]),
    "merge key": ("adapter: &a {type: can232, port: /dev/x}\nchannel: {bitrate: 125000}\nbus: {<<: *a, channel: vcan0}\n", [
        f"3:7: bus.'<<': unknown key; allowed here: {BUS_KEYS}",
    ]),
    "twice": ("adapter: {type: can232, port: /dev/x}\nchannel:\n  bitrate: 125000\n  bitrate: fast\nbus: {channel: vcan0}\nadapter: 1\n", [
        "4:3: channel.bitrate: given twice, first in line 3; remove one",
        "6:1: adapter: given twice, first in line 1; remove one",
    ]),
    "odd and twice": (bus('channel: x, "\\n": 1, "\\n": 2'), [
        f"3:19: bus.'\\n': unknown key; allowed here: {BUS_KEYS}",
        "3:28: bus.'\\n': given twice, first in line 3; remove one",
    ]),
    "in the wrong section, of usb2can": ("adapter: {type: usb2can, port: /dev/x, btr0: 1, ready: 2}\nchannel: {bitrate: 125000}\nbus: {channel: vcan0}\nready_limit: 3\n", [
        f"1:40: adapter.btr0: unknown key, it belongs to channel; allowed here: {USB2CAN_KEYS}",
        f"1:49: adapter.ready: unknown key, ready_limit is probably meant; allowed here: {USB2CAN_KEYS}",
        "4:1: ready_limit: unknown key, it belongs to adapter; allowed here: adapter, channel, bus, transmit, health, reconnect, notify",
    ]),
    "of the other adapter": (adapter("ready_limit: 99, critical_limit: 15, critical_limit: ~"), [
        "1:39: adapter.ready_limit: goes with type: usb2can; remove it",
        "1:56: adapter.critical_limit: goes with type: usb2can; remove it",
        "1:76: adapter.critical_limit: given twice, first in line 1; remove one",
    ]),
    "baudrate of usb2can": (usb2can("baudrate: fast"), ["1:40: adapter.baudrate: a USB2CAN has no baud rate, there is no serial line in it: remove it"]),
    "type": (four_lines("{type: can231, port: 'usb://1', baudrate: 49, ready_limit: 18, x: 1}"), [
        f"1:17: adapter.type: expected {TYPE_NAMES}, got the text 'can231'",
        f"1:31: adapter.port: {USB} 'usb://1'",
        f"1:52: adapter.baudrate: {BAUDRATE}, got 49",
        f"1:69: adapter.ready_limit: {READY}, got 18",
        f"1:73: adapter.x: unknown key; allowed here: {ADAPTER_KEYS}",
    ]),
    "type, of the protocol": (four_lines("{type: slcan, port: 'usb://1', ready_limit: 18}"), [
        "1:17: adapter.type: a CAN232 speaks what 'slcan' names, LAWICEL's protocol: write type: can232",
        "1:30: adapter.port: usb:// goes with type: usb2can; a CAN232 is on a serial line, such as /dev/ttyUSB0",
        "1:41: adapter.ready_limit: goes with type: usb2can; remove it",
    ]),
    "type, no text": (four_lines("{type: [usb2can], port: tcp://h}"), [
        f"1:17: adapter.type: expected {TYPE_NAMES}, got a list",
        "1:34: adapter.port: a raw TCP port is written 'socket://h'",
    ]),
    "type with a tag": (four_lines("{type: !x usb2can, port: /dev/x, baudrate: 1}"), [
        "1:17: adapter.type: the YAML tag '!x' means nothing here; remove it",
        "1:43: adapter.baudrate: a USB2CAN has no baud rate, there is no serial line in it: remove it",
    ]),
    "no type": (four_lines("{port: 'rfc2217://h:0'}"), [
        f"1:1: adapter.type: is missing; expected {TYPE_NAMES}",
        f"1:17: adapter.port: expected rfc2217://{URL} 'rfc2217://h:0'",
    ]),
    "usb2can without a port": (four_lines("{type: usb2can, ready_limit: 2, critical_limit: 2, serial_number: A}"), [
        f"1:1: adapter.port: is missing; {PORT}",
        "1:39: adapter.ready_limit: expected a limit below critical_limit (2), got 2",
    ]),
    "another serial number": (usb2can_port("'usb://0403:6001/A1', serial_number: a1"), [
        "1:69: adapter.serial_number: 'a1' is not the one in port, 'A1'; remove one of them",
    ]),
    "a wrong port, and a serial number": (usb2can_port("'usb://0403/A1', serial_number: A2"), [
        f"1:32: adapter.port: {USB} 'usb://0403/A1'",
    ]),
    "serial number of a far device": (usb2can_port("socket://h:1, serial_number: A1"), [
        "1:46: adapter.serial_number: is the USB device's, unknown through socket://; remove it",
    ]),
    "usb2can, transmit": (four_lines("{type: usb2can, port: /dev/x}", more="transmit: {window: 0}"), [
        "4:20: transmit.window: expected a number of unanswered frames from 1 to 32, got 0",
    ]),
    # combinations
    "several in a section": (four_lines("{type: can231, port: ttyUSB0, baudrate: 1.5}"), [
        f"1:17: adapter.type: expected {TYPE_NAMES}, got the text 'can231'",
        "1:31: adapter.port: a device path begins with '/', such as /dev/ttyUSB0; 'ttyUSB0' does not",
        f"1:50: adapter.baudrate: {BAUDRATE}, got 1.5",
    ]),
    "bitrate and btr": (channel("bitrate: 125000, btr1: 0x1C, btr0: 0x03"), ["2:40: channel.btr0: excludes bitrate; give bitrate, or btr0 and btr1"]),
    "half a pair": (channel("btr1: 3"), ["2:11: channel.btr1: is half of a pair; give both btr0 and btr1, or bitrate"]),
    "sample point and btr": (channel("btr0: 3, btr1: 28, sample_point: 0.8"), [
        "2:30: channel.sample_point: goes with bitrate; btr0 and btr1 say already where a bit is sampled",
    ]),
    "acceptance": (channel("bitrate: 125000, acceptance: {code: 0x100000000, mode: both, x: 1}"), [
        f"2:28: channel.acceptance.mask: is missing; {WORD}",
        f"2:47: channel.acceptance.code: {WORD}, got 0x100000000",
        "2:66: channel.acceptance.mode: expected dual or single, got the text 'both'",
        "2:72: channel.acceptance.x: unknown key; allowed here: code, mask, mode",
    ]),
    "acceptance, signs and quotes": (channel("bitrate: 125000, acceptance: {code: -1, mask: '0x1FF0'}"), [
        f"2:47: channel.acceptance.code: {WORD}, got -1",
        f"2:57: channel.acceptance.mask: {WORD}, got the text '0x1FF0' (write 0x1ff0, without quotes)",
    ]),
    "transmit when listening": (four_lines(channel="{bitrate: 125000, listen_only: true}", more="transmit: {queue: 0}"), [
        "4:1: transmit: nothing is sent with channel.listen_only: true; remove this section, or listen_only",
        "4:19: transmit.queue: expected a number of frames from 1 to 65536, got 0",
    ]),
    "options": (bus("interface: virtual, channel: x, a: {b: c}, d: [[]], e: &e [*e], f-g: 1, bustype: x, h: !x 1, i: [!y z]"), [
        f"3:42: bus.a: {SINGLE}",
        f"3:53: bus.d: {SINGLE}",
        f"3:62: bus.e: {SINGLE}",
        "3:71: bus.f-g: unknown key; expected the name of an option, such as hop_limit",
        "3:79: bus.bustype: cannot be given; write interface",
        "3:94: bus.h: the YAML tag '!x' means nothing here; remove it",
        "3:103: bus.i: the YAML tag '!y' means nothing here; remove it",
    ]),
    "echo": (bus("interface: virtual, channel: x, receive_own_messages: true"), [
        "3:39: bus.receive_own_messages: cannot be given; the bridge needs it off: it would send frames back to where they came from",
    ]),
    "tags": ("adapter: !!python/object:os.system {type: can232}\nchannel: {bitrate: !!python/name:os.system '', btr0: !foo 3}\nbus: {!!python/name:a b: 1, channel: x}\n", [
        "1:10: adapter: the YAML tag '!!python/object:os.system' means nothing here; remove it",
        "2:20: channel.bitrate: the YAML tag '!!python/name:os.system' means nothing here; remove it",
        "2:48: channel.btr0: excludes bitrate; give bitrate, or btr0 and btr1",
        "2:54: channel.btr0: the YAML tag '!foo' means nothing here; remove it",
        "3:7: bus: a key is a single word",
    ]),
    "recursive": ("&r {adapter: {type: can232, port: *r}, channel: {bitrate: 125000}, bus: *r}", [
        f"1:1: adapter.port: {PORT}, got a mapping",
        f"1:5: bus.adapter: unknown key; allowed here: {BUS_KEYS}",
        "1:49: bus.channel: expected the name of an interface, got a mapping",
        f"1:68: bus.bus: unknown key; allowed here: {BUS_KEYS}",
    ]),
}  # fmt: skip


@pytest.mark.parametrize(("content", "expected"), CASES.values(), ids=CASES.keys())
def test_problems(file: Path, content: str | bytes, expected: list[str]) -> None:
    assert problems_of(file, content) == expected


@needs_calculator
def test_sample_point_out_of_reach(file: Path) -> None:
    assert problems_of(file, channel("bitrate: 320000, sample_point: 0.9")) == [
        "2:42: channel.sample_point: 0.9 cannot be had at 320000 bit/s; nearest is 0.68; or give btr0 and btr1"
    ]


@pytest.mark.parametrize(
    ("value", "command"),
    [
        ("[/usr/local/bin/tell]", ("/usr/local/bin/tell",)),
        ("[tell, pc, 0123, yes, '']", ("tell", "pc", "0123", "yes", "")),
        ("\n- tell\n- pc", ("tell", "pc")),
    ],
)
def test_the_command_of_notify(file: Path, value: str, command: tuple[str, ...]) -> None:
    """Its words are taken as they are written."""
    file.write_text(four_lines("{type: can232, port: /dev/x}") + f"notify: {value}\n")
    assert load(file).notify == command


@pytest.mark.parametrize(
    ("value", "got"),
    [
        ("/usr/local/bin/tell", "the text '/usr/local/bin/tell'"),
        ("", "nothing"),
        ("[]", "a list"),
        ("['']", "another list"),
        ("[tell, [pc]]", "another list"),
        ("[tell, !secret pc]", "another list"),
        ('["tell", "a\\nb"]', "another list"),
        ("{run: tell}", "a mapping"),
    ],
)
def test_no_command_for_notify(file: Path, value: str, got: str) -> None:
    text = four_lines("{type: can232, port: /dev/x}") + f"notify: {value}\n"
    line = text.count("\n")
    wanted = "expected a list with a command and its arguments, such as [/usr/local/bin/tell, pc]"
    (problem,) = problems_of(file, text)
    assert re.fullmatch(rf"{line}:\d+: notify: {re.escape(wanted)}, got {re.escape(got)}", problem)


def test_python_can_too_old(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Debian 12 has python-can 4.1: the bit rates of the S command work, others say what is missing."""
    monkeypatch.delattr(python_can.BitTiming, "iterate_from_sample_point", raising=False)
    assert problems_of(file, channel("bitrate: 125000")) == []
    assert problems_of(file, channel("bitrate: 83333")) == [
        "2:20: channel.bitrate: the bit timing for 83333 bit/s takes python-can 4.3 or newer; "
        "or give btr0 and btr1"
    ]
    assert problems_of(file, channel("bitrate: 125000, sample_point: 0.8")) == [
        "2:42: channel.sample_point: the bit timing for 125000 bit/s takes python-can 4.3 or newer; "
        "or give btr0 and btr1"
    ]


def test_every_value_has_a_description() -> None:
    """read() needs one; only a section has none."""
    for schema in (*config._schemas().values(), *map(settings_of, TYPES)):
        for field in msgspec.structs.fields(schema):
            parts = [field.type, *get_args(field.type)]
            metas = [meta for part in parts for meta in getattr(part, "__metadata__", ())]
            described = any(meta.description for meta in metas)
            assert described or config._AcceptanceKeys in parts, f"{schema.__name__}.{field.name}"


@pytest.mark.parametrize("name", ["can232.yaml", "usb2can.yaml"])
def test_a_right_file_is_cheap(name: str) -> None:
    code = (
        "import sys; from bridged.config import load; load(sys.argv[1]);"
        "print(*{'can', 'difflib', 'serial', 'asyncio'} & set(sys.modules))"
    )
    command = [sys.executable, "-c", code, str(REPOSITORY / "config" / name)]
    assert subprocess.run(command, capture_output=True, text=True, check=True, cwd=REPOSITORY).stdout == "\n"
