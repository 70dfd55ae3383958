"""The relay in C: which part may include which, and that the build knows each of its files."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

import bridged

ROOT = Path(bridged.__file__).parents[1]
RELAY = ROOT / "bridged" / "relay"
MODULE = {"values", "counters", "codec", "clock", "relay"}
# Each part and those that it may include, in its header or its source; only those above it in this list.
ALLOWED: dict[str, set[str]] = {
    "counters": set(),
    "codec": set(),
    "values": {"codec", "counters"},
    "codec_can232": {"codec"},
    "codec_usb2can": {"codec"},
    "clock": {"values"},
    "events": {"counters", "values"},
    "queue": {"counters", "values"},
    "line": {"codec", "events", "queue"},
    "ack_window": {"line", "queue"},
    "level_window": {"line", "queue"},
    "pace": {"values"},
    "transmit": {"ack_window", "level_window", "pace"},
    "receive": {"codec", "transmit"},
    "intake": {"clock", "events", "queue"},
    "relay": {"clock", "codec", "counters", "intake", "receive", "values"},
    "module": MODULE,
    "module_codecs": {"module"},
    "module_counters": {"module"},
}


def files() -> list[Path]:
    return sorted(path for path in RELAY.iterdir() if path.suffix in {".c", ".h"})


def includes(path: Path) -> set[str]:
    return set(re.findall(r'^#\s*include\s+"(\w+)\.h"', path.read_text(), re.MULTILINE))


@pytest.mark.parametrize("path", files(), ids=lambda path: path.name)
def test_a_part_includes_only_those_below_it(path: Path) -> None:
    assert includes(path) - {path.stem} <= ALLOWED[path.stem]


def test_includes_go_one_way() -> None:
    above = list(ALLOWED)
    for part, allowed in ALLOWED.items():
        assert all(above.index(below) < above.index(part) for below in allowed), part


def test_only_relay_c_knows_what_a_relay_is() -> None:
    with_it = [
        path.name for path in files() if re.search(r"^struct relay \{", path.read_text(), re.MULTILINE)
    ]
    assert with_it == ["relay.c"]


def test_a_part_changes_no_struct_but_its_own() -> None:
    """The counters are everybody's."""
    parts = "queue|line|ack|level|transmit|receive|intake|events"
    write = re.compile(rf"(?:->|\.)(?:{parts})(?:->|\.)\w+(?:\[\w+\])? ?(?:[-+*|]?=[^=]|\+\+|--)")
    assert [path.name for path in files() if write.search(path.read_text())] == []


def test_the_build_has_each_file_of_the_relay() -> None:
    (module,) = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["ext-modules"]
    names = [path.relative_to(ROOT).as_posix() for path in files()]
    assert sorted(module["sources"]) == [name for name in names if name.endswith(".c")]
    assert sorted(module["depends"]) == [name for name in names if name.endswith(".h")]


@pytest.mark.parametrize("path", files(), ids=lambda path: path.name)
def test_no_line_is_too_long(path: Path) -> None:
    assert [n for n, line in enumerate(path.read_text().splitlines(), 1) if len(line) > 118] == []
