"""What the README says: its configuration loads, its commands exist, its texts are the program's own."""

import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from bridged import _relay, cli, config
from bridged.bridge.lifecycle import State
from bridged.interfaces.base import LOST_BEFORE_READ

TOP = Path(__file__).parents[2]
README = (TOP / "README.md").read_text()
SOURCES = "".join(path.read_text() for path in (TOP / "bridged").rglob("*.py"))


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_first_configuration_loads(tmp_path: Path) -> None:
    (block,) = blocks("yaml")
    path = tmp_path / "can232.yaml"
    path.write_text(block)
    assert config.load(path).bus.create


def test_the_configuration_without_a_file_loads(tmp_path: Path) -> None:
    (block,) = [block for block in blocks("sh") if "CAN_BRIDGE__" in block]
    script = block.replace("can-bridge run", "env")
    lines = subprocess.run(
        ["sh", "-euc", script], env={"PATH": os.environ["PATH"]}, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    loaded = config.load(tmp_path / "can-bridge.yaml", dict(line.split("=", 1) for line in lines))
    assert loaded.bus.create
    assert loaded.channel.acceptance is not None


def test_every_command_is_one() -> None:
    lines = [line for block in blocks("sh") for line in block.splitlines()] + re.findall(
        r"`(can-bridge .*?)`", README
    )
    commands = [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("can-bridge ")]
    assert len(commands) >= 4
    for command in commands:
        cli._parser(command).parse_args(command)


def test_dev_has_every_command_that_is_named() -> None:
    usage = (TOP / "dev").read_text()
    for command in set(re.findall(r"\./dev ([a-z]+)", README)):
        assert f"\n    {command}" in usage, command


def test_every_linked_file_exists() -> None:
    for link in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (TOP / link).exists(), link


@pytest.mark.parametrize("text", re.findall(r"^\| `([^`]+?)(?: …)?` \|", README, re.MULTILINE))
def test_every_error_text_is_one_of_ours(text: str) -> None:
    for part in re.split(r"(?<=refused to) | dialout", text):  # put together at run time
        assert part in SOURCES, part


def test_every_state_is_explained() -> None:
    rows = re.findall(r"^\| `([a-z-]+)` \|[^|]+\|[^|]+\|$", README, re.MULTILINE)
    assert sorted(rows) == sorted(state.value for state in State)


def test_every_reason_is_explained() -> None:
    relay = _relay.Relay(
        "can232", queue=1, window=1, deadline=1, stuck=1, answer_timeout=1, sync=b"V\r", sync_prefix=b"V"
    )
    reasons = relay.counters()["tx_dropped"]
    assert isinstance(reasons, dict)
    for reason in (*reasons, LOST_BEFORE_READ[0]):
        assert f"`{reason}`" in README, f"README.md, `tx_dropped` reasons: what is `{reason}`?"
