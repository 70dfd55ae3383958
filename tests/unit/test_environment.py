"""bridged.environment: a configuration in environment variables, alone and over a file."""
# ruff: noqa: E501 - in the tables, a message is one line as the user sees it

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from bridged.config import check, load
from bridged.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping

EXAMPLES = sorted((Path(__file__).parents[2] / "config").glob("*.yaml"))
ALL = {
    "CAN_BRIDGE__ADAPTER__TYPE": "can232",
    "CAN_BRIDGE__ADAPTER__PORT": "/dev/ttyUSB0",
    "CAN_BRIDGE__ADAPTER__BAUDRATE": "57600",
    "CAN_BRIDGE__CHANNEL__BITRATE": "125000",
    "CAN_BRIDGE__BUS__CHANNEL": "vcan0",
}
FILE = """\
adapter: {type: can232, port: /dev/ttyUSB0, baudrate: 57600}
channel:
  bitrate: 125000
bus: {channel: vcan0}
"""


def as_variables(document: Mapping[str, Any], prefix: str = "CAN_BRIDGE") -> dict[str, str]:
    """Each key of a document by the rule; a list or a single value as YAML text."""
    found: dict[str, str] = {}
    for key, value in document.items():
        name = f"{prefix}__{key.upper()}"
        if isinstance(value, dict):
            found |= as_variables(value, name)
        else:
            found[name] = yaml.safe_dump(value, default_flow_style=True).removesuffix("...\n")
    return found


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_every_key_of_the_examples(example: Path, tmp_path: Path) -> None:
    """All from the environment is the same as all from the file."""
    missing = tmp_path / example.name
    given = as_variables(yaml.safe_load(example.read_text())) | {
        "CAN_BRIDGE_PORT": "tcp://10.0.0.1:80",
        "HOME": "/",
    }
    expected = load(example)
    assert load(missing, given) == type(expected)(
        **{name: getattr(expected, name) for name in expected.__struct_fields__ if name != "path"},
        path=missing,
    )


@pytest.mark.parametrize(
    ("variables", "same_as"),
    [
        ({}, FILE),
        ({"CAN_BRIDGE__CHANNEL__BITRATE": "500000"}, FILE.replace("125000", "500000")),
        ({"CAN_BRIDGE__TRANSMIT__DEADLINE": "0.5"}, f"{FILE}transmit: {{deadline: 0.5}}\n"),
        ({"CAN_BRIDGE__CHANNEL": "{bitrate: 250000, listen_only: true}"}, FILE.replace("125000", "250000\n  listen_only: true")),
        ({"CAN_BRIDGE__CHANNEL": "{bitrate: 1}", "CAN_BRIDGE__CHANNEL__BITRATE": "250000"}, FILE.replace("125000", "250000")),
        ({"CAN_BRIDGE__CHANNEL__ACCEPTANCE": "{code: 0x6000, mask: 0x1FF0}", "CAN_BRIDGE__CHANNEL__ACCEPTANCE__MODE": "single"},
         FILE.replace("125000", "125000\n  acceptance: {code: 0x6000, mask: 0x1FF0, mode: single}")),
        ({"CAN_BRIDGE__BUS__INTERFACE": "udp_multicast", "CAN_BRIDGE__BUS__HOP_LIMIT": "2", "CAN_BRIDGE__BUS__SOME": "[1, a]"},
         FILE.replace("channel: vcan0", "channel: vcan0, interface: udp_multicast, hop_limit: 2, some: [1, a]")),
        ({"CAN_BRIDGE__ADAPTER__SERIAL_NUMBER": "0123"}, FILE.replace("57600", "57600, serial_number: 0123")),
    ],
)  # fmt: skip
def test_the_environment_wins(tmp_path: Path, variables: dict[str, str], same_as: str) -> None:
    file, other = tmp_path / "a.yaml", tmp_path / "b" / "a.yaml"
    other.parent.mkdir()
    file.write_text(FILE)
    other.write_text(same_as)
    assert load(file, variables) == type(load(other))(
        **{name: getattr(load(other), name) for name in load(other).__struct_fields__ if name != "path"},
        path=file,
    )
    file.write_text("")  # an empty file is as good as none
    assert load(file, ALL).channel == load(file.with_name("none.yaml"), ALL).channel


@pytest.mark.parametrize(
    ("variables", "problems"),
    [
        ({"CAN_BRIDGE__CHANNEL__BITRATE": "fast"},
         ["CAN_BRIDGE__CHANNEL__BITRATE: channel.bitrate: expected a bit rate from 10000 to 1000000 bit/s (a slower one by btr0 and btr1), got the text 'fast'"]),
        ({"CAN_BRIDGE__CHANNEL__ACCEPTANCE": "{code: 1, mask: x}"},
         ["CAN_BRIDGE__CHANNEL__ACCEPTANCE:1:17: channel.acceptance.mask: expected a number from 0x00000000 to 0xFFFFFFFF, got the text 'x'"]),
        ({"CAN_BRIDGE__CHANEL__BITRATE": "1"},
         ["CAN_BRIDGE__CHANEL__BITRATE: chanel: unknown key, channel is probably meant; allowed here: adapter, channel, bus, transmit, health, reconnect, notify"]),
        ({"CAN_BRIDGE__CHANNEL__BTR0": "1"},
         ["CAN_BRIDGE__CHANNEL__BTR0: channel.btr0: excludes bitrate; give bitrate, or btr0 and btr1"]),
        ({"CAN_BRIDGE__BUS": "{channel: vcan0"},
         ["CAN_BRIDGE__BUS:1:16: not valid YAML: expected ',' or '}', but got '<stream end>'"]),
        ({"CAN_BRIDGE__BUS__CHANNEL": "a\x07"},
         ["CAN_BRIDGE__BUS__CHANNEL:1:2: not valid YAML: character U+0007 is not allowed"]),
        ({"CAN_BRIDGE__BUS__CHANNEL": ""},
         ["CAN_BRIDGE__BUS__CHANNEL: bus.channel: is empty; expected the name of an interface"]),
        ({"CAN_BRIDGE__BUS__": "x", "CAN_BRIDGE__": "y"},
         ["CAN_BRIDGE__: names no key; expected CAN_BRIDGE__SECTION__KEY",
          "CAN_BRIDGE__BUS__: names no key; expected CAN_BRIDGE__SECTION__KEY"]),
        ({"CAN_BRIDGE_CHANNEL__LISTEN_ONLY": "true", "CAN_BRIDGE_PORT": "tcp://10.0.0.1:80"},
         ["CAN_BRIDGE_CHANNEL__LISTEN_ONLY: has one underscore too few; CAN_BRIDGE__CHANNEL__LISTEN_ONLY is probably meant"]),
        ({"CAN_BRIDGE__BUS__CHANNEL": "a", "CAN_BRIDGE__bus__channel": "b"},
         ["CAN_BRIDGE__bus__channel: is the same key as CAN_BRIDGE__BUS__CHANNEL; remove one of them"]),
        ({"CAN_BRIDGE__CHANNEL__BITRATE__X": "5", "CAN_BRIDGE__NOTIFY": "[a]", "CAN_BRIDGE__NOTIFY__B": "c"},
         ["CAN_BRIDGE__CHANNEL__BITRATE__X: cannot be set: channel.bitrate has a value that is no section",
          "CAN_BRIDGE__NOTIFY__B: cannot be set: notify has a value that is no section"]),
        ({"CAN_BRIDGE__HEALTH__INTERVAL": "9", "CAN_BRIDGE__TRANSMIT": "3"},
         ["CAN_BRIDGE__HEALTH__INTERVAL: health.interval: expected a number of seconds from 0.1 to 0.5, got 9",
          "CAN_BRIDGE__TRANSMIT: transmit: expected a section with queue, window, deadline, got 3"]),
    ],
)  # fmt: skip
def test_errors_name_the_variable(tmp_path: Path, variables: dict[str, str], problems: list[str]) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(FILE)
    assert problems_of(file, variables) == problems


def problems_of(file: Path, variables: dict[str, str]) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        load(file, variables)
    return caught.value.problems


def test_errors_of_the_file_come_first(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(FILE.replace("channel:\n  bitrate: 125000", "channel: 5"))
    problems = problems_of(file, {"CAN_BRIDGE__CHANNEL__BITRATE": "1", "CAN_BRIDGE__BUS__CREATE": "maybe"})
    assert [problem.partition(": ")[0] for problem in problems] == [
        f"{file}:2:10",
        "CAN_BRIDGE__BUS__CREATE",
        "CAN_BRIDGE__CHANNEL__BITRATE",
    ]


def test_what_is_missing_without_a_file(tmp_path: Path) -> None:
    """Each with the variable that would give it; and that the file is not there, which may be the cause."""
    file = tmp_path / "none.yaml"
    given = {"CAN_BRIDGE__ADAPTER__TYPE": "can232", "CAN_BRIDGE__CHANNEL__LISTEN_ONLY": "true"}
    assert problems_of(file, given) == [
        f"{file}: there is no such file: the environment is all there is",
        "CAN_BRIDGE__ADAPTER__TYPE: adapter.port: is missing (CAN_BRIDGE__ADAPTER__PORT); expected a device path like /dev/ttyUSB0 or a URL like socket://HOST:PORT",
        "CAN_BRIDGE__CHANNEL__LISTEN_ONLY: channel.bitrate: is missing (CAN_BRIDGE__CHANNEL__BITRATE); expected a bit rate in bit/s (or btr0 and btr1)",
        "the environment: bus: is missing (CAN_BRIDGE__BUS); expected a section with channel",
    ]


def test_a_file_that_cannot_be_read_is_no_missing_one(tmp_path: Path) -> None:
    assert problems_of(tmp_path, ALL) == [f"{tmp_path}: cannot be read: Is a directory"]


def test_doubts_name_the_variable(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(FILE)
    (doubt,) = check(file, {"CAN_BRIDGE__TRANSMIT__DEADLINE": "100"})[1]
    assert doubt.startswith(
        "CAN_BRIDGE__TRANSMIT__DEADLINE: transmit.deadline: warning: a frame may reach the bus"
    )
