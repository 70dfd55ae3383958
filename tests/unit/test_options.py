"""bridged.options: a configuration in options of the command line, without a file."""
# ruff: noqa: E501 - in the tables, a message is one line as the user sees it

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import msgspec
import pytest
import yaml

from bridged import cli
from bridged.config import keys, load, load_options
from bridged.errors import ConfigError
from bridged.options import names, take

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bridged.settings import Config

EXAMPLES = sorted((Path(__file__).parents[2] / "config").glob("*.yaml"))
ALL = ["--type", "can232", "--port", "/dev/ttyUSB0", "--bitrate", "125000", "--bus.channel", "vcan0"]


def given(*arguments: str) -> Config:
    settings, others = take(arguments, keys())
    assert others == []
    return load_options(settings)


def as_options(document: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Each key of a document by the rule; a list as YAML text."""
    found: list[str] = []
    for key, value in document.items():
        if isinstance(value, dict):
            found += as_options(value, f"{prefix}{key}.")
        else:
            text = yaml.safe_dump(value, default_flow_style=True).removesuffix("...\n")
            found.append(f"--{prefix}{key.replace('_', '-')}={text}")
    return found


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_every_key_of_the_examples(example: Path) -> None:
    """All by options is the same as all in a file."""
    expected = load(example)
    same = {"name": expected.name, "path": expected.path}
    found = given(*as_options(yaml.safe_load(example.read_text())))
    assert msgspec.structs.replace(found, **same) == expected


def test_a_key_that_only_one_section_has_needs_no_section() -> None:
    assert given(*ALL).channel.timing.bitrate == 125_000
    assert given(*ALL, "--transmit.deadline", "0.5") == given(*ALL, "--deadline=0.5")
    found = names(keys())
    assert "bitrate" in found
    assert found["channel"] == ("channel",)  # the section, not the key of bus


def test_true_or_false() -> None:
    """Such a key takes no word behind it."""
    settings, others = take(["--create", "vcan0", "--listen-only=false"], keys())
    assert [(setting.path, setting.text) for setting in settings] == [
        (("bus", "create"), "true"),
        (("channel", "listen_only"), "false"),
    ]
    assert others == ["vcan0"]


def test_what_is_no_key_is_left() -> None:
    arguments = ["run", "--socket", "/run/x", "--bitrate", "1", "--verbose", "vcan0", "--", "--port"]
    _, others = take(arguments, keys())
    assert others == ["run", "--socket", "/run/x", "--verbose", "vcan0", "--", "--port"]


def test_no_option_of_run_is_a_key() -> None:
    assert not {name.removeprefix("--").replace("-", "_") for name in cli.RUN_OPTIONS} & names(keys()).keys()


def test_run_knows_its_own_options() -> None:
    """Any other option is looked for among the keys."""
    (commands,) = [
        action for action in cli._parser(["run", "--help"])._actions if isinstance(action.choices, dict)
    ]
    run: Any = commands.choices["run"]  # type: ignore[index,call-overload]
    options = {option for action in run._actions for option in action.option_strings}
    shown = {option.removeprefix("--").replace("-", "_") for option in options - cli.RUN_OPTIONS}
    assert options >= cli.RUN_OPTIONS
    assert shown - {"h", "_h", "help"} <= names(keys()).keys()


@pytest.mark.parametrize(
    ("arguments", "problems"),
    [
        (["--bitrate", "fast"],
         ["--bitrate: channel.bitrate: expected a bit rate from 10000 to 1000000 bit/s (a slower one by btr0 and btr1), got the text 'fast'"]),
        (["--channel.acceptance", "{code: 1, mask: x}"],
         ["--channel.acceptance:1:17: channel.acceptance.mask: expected a number from 0x00000000 to 0xFFFFFFFF, got the text 'x'"]),
        (["--transmit.dedline", "1"],
         ["--transmit.dedline: transmit.dedline: unknown key, deadline is probably meant; allowed here: queue, window, deadline"]),
        (["--port", "/dev/a", "--adapter.port", "/dev/b"],
         ["--port: is the same key as --adapter.port; remove one of them"]),
        (["--create=maybe"], ["--create: bus.create: expected true or false, got the text 'maybe'"]),
        (["--port="], ["--port: adapter.port: is empty; expected a device path like /dev/ttyUSB0 or a URL like socket://HOST:PORT"]),
    ],
)  # fmt: skip
def test_errors_name_the_option(arguments: list[str], problems: list[str]) -> None:
    options = [option.partition("=")[0] for option in arguments]
    base = [word for pair in zip(ALL[::2], ALL[1::2], strict=True) for word in pair if pair[0] not in options]
    if "--adapter.port" in options:
        base = ALL[:2] + ALL[4:]
    with pytest.raises(ConfigError) as caught:
        given(*base, *arguments)
    assert caught.value.problems == problems


def test_what_is_missing() -> None:
    """Each with the option that would give it."""
    with pytest.raises(ConfigError) as caught:
        given("--type", "can232", "--listen-only")
    assert caught.value.problems == [
        "--listen-only: channel.bitrate: is missing (--channel.bitrate); expected a bit rate in bit/s (or btr0 and btr1)",
        "--type: adapter.port: is missing (--adapter.port); expected a device path like /dev/ttyUSB0 or a URL like socket://HOST:PORT",
        "the command line: bus: is missing (--bus); expected a section with channel",
    ]


@pytest.mark.parametrize("arguments", [["--bitrate"], ["--port", "--bitrate", "1"]])
def test_a_value_is_missing(arguments: list[str]) -> None:
    with pytest.raises(ConfigError, match=f"^{arguments[0]}: expected a value behind it$"):
        take(arguments, keys())


def test_a_file_and_options_exclude_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Else the file would be taken for the name of an interface."""
    assert cli.main(["run", str(tmp_path / "pc.yaml"), "--bitrate", "125000"]) == cli.EX_CONFIG
    assert "a file is not read where options are keys (--bitrate)" in capsys.readouterr().err


def test_an_abbreviation_is_not_passed_over(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(["run", "--type", "can232", "--bitr", "125000", "vcan0"])
    assert "unrecognized arguments: --bitr" in capsys.readouterr().err


def wait_for(text: str, output: IO[str]) -> list[str]:
    """The lines up to the one with the text."""
    lines = [output.readline()]
    while text not in lines[-1]:
        assert lines[-1], f"ended without {text!r}: {lines}"
        lines.append(output.readline())
    return lines


def test_a_bridge_without_a_file(tmp_path: Path) -> None:
    """The name of its interface is its own; there is no file that a reload could read."""
    options = [*ALL[:2], "--port", "/nowhere/tty", *ALL[4:6], "--interface", "virtual"]
    with subprocess.Popen(
        [sys.executable, "-m", "bridged", "run", *options, "--socket", str(tmp_path / "socket"), "one"],
        env={**os.environ, "STATE_DIRECTORY": str(tmp_path)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # without a terminal SIGHUP means reload
    ) as process:
        assert process.stderr is not None
        (first,) = wait_for("can-bridge", process.stderr)
        assert "one: can-bridge" in first
        assert first.endswith(": the command line: can232 on /nowhere/tty to virtual one\n")
        wait_for("state=waiting", process.stderr)
        process.send_signal(signal.SIGHUP)
        wait_for("reload refused: there is no file to read again", process.stderr)
        process.send_signal(signal.SIGTERM)
        wait_for("stopped after", process.stderr)
    assert process.returncode == 0


def test_a_start_with_a_file_loads_nothing_for_it(tmp_path: Path) -> None:
    """Neither for options, nor for a list, nor for a command of `notify` that is not there."""
    file = tmp_path / "one.yaml"
    text = "adapter: {type: can232, port: /x}\nchannel: {bitrate: 125000}\nbus: {interface: virtual, channel: a}\n"
    file.write_text(text)
    code = (
        "import sys; from bridged.cli import main; main(sys.argv[1:]); "
        "print(*(name for name in sys.modules if name.startswith('bridged')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "run", "--socket", "/proc/none/socket", str(file)],
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = set(done.stdout.split())
    assert "bridged.daemon.service" in loaded, done.stderr
    rare = {"bridged.overlay", "bridged.options", "bridged.listing", "bridged.daemon.state_hook"}
    assert not loaded & rare
