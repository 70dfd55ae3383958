"""bridged.config: whatever a file holds, it loads or the problems say why not."""
# ruff: noqa: E501 - tables

from __future__ import annotations

import re
import warnings
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from bridged import config
from bridged.adapters.usb2can import Usb2canConfig
from bridged.config import load
from bridged.errors import ConfigError
from bridged.yaml_source import key_names

with warnings.catch_warnings(action="ignore"):  # python-can 4.1 on Python 3.11
    import can  # noqa: F401 - load() imports it for some bit rates

DIRECTORY = Path(__file__).parents[2] / "config"
EXAMPLES = [(DIRECTORY / name).read_text() for name in ("can232.yaml", "usb2can.yaml")]

YAML_BREAK = re.compile(r"\r\n|[\n\r\x85\u2028\u2029]")
PROBLEM = re.compile(r"(\d+):(\d+): \S.*")


def check_anything(file: Path, content: bytes) -> None:
    """Load a file: a configuration, or problems in order, each a line of text and within the file."""
    file.write_bytes(content)
    problems = []
    try:
        assert load(file).path == file
    except ConfigError as error:
        problems = [problem.removeprefix(f"{file}:") for problem in error.problems]
    positions = []
    text = content.decode("utf-8", "replace")
    lines = len(YAML_BREAK.split(text))
    longest = max(map(len, text.split("\n")))
    for problem in problems:
        match = PROBLEM.fullmatch(problem)
        assert match, problem
        assert problem.isprintable()
        position = int(match[1]), int(match[2])
        assert 1 <= position[0] <= lines
        assert 1 <= position[1] <= longest + 1
        positions.append(position)
    assert positions == sorted(positions)


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz") / "fuzz.yaml"


PIECES = (
    *"{}[]:,&*!|>%@`'\"#?-~\n\t \\",
    *(": ", "- ", "<<: ", "&a ", "*a", "!!int ", "!!float ", "!!bool ", "!!python/name:x ", "!!set ", "---\n", "...\n"),
    *("null", "yes", "0x", "0b1", "017", "1e9", ".nan", "-.inf", "12:30", "2026-01-01", "1_0", "\\ud800", "\\U00110000"),
    *("é", "\u2028", "\x85", "\ufeff", "\U0001f697", "\x00", "\r"),
    *("adapter", "channel", "bus", "transmit", "bitrate: 83333", "btr0: 1", "interface: virtual", "socket://h:1"),
    *("can232", "usb2can", "usb://", "usb://0403:6001/A1", "rfc2217://h:1", "baudrate: 1", "ready_limit: 15", "serial_number: A2"),
)  # fmt: skip


@given(
    st.text(
        st.sampled_from("{}[]:,&*!|>%@'\"#?-~\n\t ab01\\uxUr\u2028\x85\x00é") | st.characters(codec="utf-8")
    )
)
def test_any_text(fuzzed: Path, text: str) -> None:
    check_anything(fuzzed, text.encode())


@given(st.binary())
def test_any_bytes(fuzzed: Path, content: bytes) -> None:
    check_anything(fuzzed, content)


@given(
    st.sampled_from(EXAMPLES),
    st.lists(
        st.tuples(
            st.integers(0, max(map(len, EXAMPLES))), st.integers(0, 12), st.sampled_from(["", *PIECES])
        ),
        max_size=6,
    ),
)
def test_any_damage(fuzzed: Path, text: str, cuts: list[tuple[int, int, str]]) -> None:
    for start, length, piece in cuts:
        text = text[:start] + piece + text[start + length :]
    check_anything(fuzzed, text.encode())


SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20) | st.sampled_from(PIECES)
)
KEYS = st.sampled_from([key for schema in config._schemas().values() for key in key_names(schema)])
SECTION = st.dictionaries(KEYS | st.text(max_size=5), SCALARS | st.lists(SCALARS, max_size=3), max_size=6)


@given(st.dictionaries(st.sampled_from(["adapter", "channel", "bus", "transmit"]), SECTION | SCALARS))
def test_any_values(fuzzed: Path, values: dict[str, object]) -> None:
    check_anything(fuzzed, yaml.safe_dump(values, allow_unicode=True).encode("utf-8", "replace"))


ADAPTER = st.fixed_dictionaries(
    {
        "type": st.sampled_from(["can232", "usb2can"]),
        "port": st.sampled_from(
            ["/dev/x", "socket://h:1", "rfc2217://h:1", "usb://0403:6001", "usb://0403:6001/A1", "usb://1:1"]
        ),
    },
    optional={
        "serial_number": st.sampled_from(["A1", "A2"]),
        "baudrate": st.integers(49, 4_000_001),
        "critical_limit": st.integers(0, 19),
        "ready_limit": st.integers(-1, 18),
    },
)
TRANSMIT = st.fixed_dictionaries({}, optional={"window": st.integers(0, 33), "deadline": st.floats(0, 60)})


@given(ADAPTER, TRANSMIT)
def test_any_adapter(fuzzed: Path, adapter: dict[str, object], transmit: dict[str, object]) -> None:
    """What loads keeps to the documents of both adapters, whatever was left out."""
    sections = {"adapter": adapter, "channel": {"bitrate": 125_000}, "bus": {"channel": "vcan0"}}
    text = yaml.safe_dump({**sections, "transmit": transmit}, allow_unicode=True)
    check_anything(fuzzed, text.encode("utf-8", "replace"))
    try:
        loaded = load(fuzzed)
    except ConfigError:
        return
    assert loaded.adapter.type == adapter["type"]
    assert 1 <= loaded.transmit.window <= 32
    if isinstance(loaded.adapter, Usb2canConfig):
        assert "baudrate" not in adapter
        assert 0 <= loaded.adapter.ready_limit < loaded.adapter.critical_limit <= 18
        serial_number = loaded.adapter.serial_number
        in_port = loaded.adapter.port.partition("/A")[2]
        assert serial_number is None or not in_port or serial_number == f"A{in_port}"
        assert not loaded.adapter.port.startswith("rfc2217")
    else:
        assert not {"critical_limit", "ready_limit"} & set(adapter)
        assert not loaded.adapter.port.startswith("usb")
