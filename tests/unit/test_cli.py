"""The commands as a user meets them: what they show, say and return, and what becomes of it in a pipe."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from benches.status_socket import serving, snapshot

from bridged import VERSION, cli, interfaces
from bridged.daemon import directories, privileges, status_text
from bridged.errors import InterfaceError
from bridged.interfaces import socketcan
from bridged.settings import BusConfig

CONFIG = """\
adapter: {type: can232, port: /nowhere/tty, baudrate: 115200}
channel: {bitrate: 125000}
bus: {interface: virtual, channel: a}
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The directory of the status sockets, of root's bridges and ours."""
    monkeypatch.setattr(directories, "SYSTEM_RUNTIME", tmp_path)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    return tmp_path


@pytest.fixture
def configs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    directory = tmp_path / "etc"
    directory.mkdir()
    (directory / "can232.yaml").write_text(CONFIG)
    monkeypatch.setattr(cli, "CONFIG_DIRECTORY", directory)
    return directory


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--version"])
    assert capsys.readouterr().out == f"can-bridge {VERSION}\n"


class TestStatus:
    def test_the_only_one_is_shown_in_full(self, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
        with serving(run / "can232.sock", snapshot()):
            assert cli.main(["status"]) == 0
            text = capsys.readouterr().out
            assert text == f"{status_text.render(snapshot())}\n"
            assert cli.main(["status", "can232"]) == 0
            assert capsys.readouterr().out == text
            assert cli.main(["status", "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == snapshot()

    def test_several_have_a_line_each(self, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
        waiting = snapshot("b", state="waiting", reason="/dev/ttyUSB1: does not exist")
        with serving(run / "a.sock", snapshot("a")), serving(run / "b.sock", waiting):
            assert cli.main(["status"]) == 3
            assert capsys.readouterr().out.splitlines() == [
                "a: running, up 9 s, 20 frames received, 84 sent, 0 dropped",
                "b: waiting, up 9 s, 20 frames received, 84 sent, 0 dropped (/dev/ttyUSB1: does not exist)",
            ]
            assert cli.main(["status", "--json"]) == 3
            lines = capsys.readouterr().out.splitlines()
            assert [json.loads(line)["name"] for line in lines] == ["a", "b"]
            assert cli.main(["status", "a"]) == 0

    def test_one_of_several_that_was_killed(self, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
        with serving(run / "b.sock", snapshot("b")):
            with serving(run / "a.sock", snapshot("a")):
                (run / "a.sock").rename(run / "c.sock")
            assert cli.main(["status"]) == 3
            first, second = capsys.readouterr().out.splitlines()
            assert first.startswith("b: running")
            assert second == f"c: no bridge answers on {run}/c.sock: Connection refused"
            assert cli.main(["status", "--json"]) == 3
        out, err = capsys.readouterr()
        assert json.loads(out)["name"] == "b"
        assert err.startswith("can-bridge: c: no bridge answers")

    def test_none_runs(
        self, run: Path, configs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def said(*arguments: str) -> str:
            assert cli.main(["status", *arguments]) == 3
            return capsys.readouterr().err

        assert said() == "can-bridge: no bridge is running: start one with `can-bridge run NAME`\n"
        hint = "start it with `can-bridge run can232` or `systemctl start can-bridge@can232`"
        assert said("can232") == f"can-bridge: can232 is not running: {hint}\n"
        assert said("other") == f"can-bridge: other is not running, and there is no {configs}/other.yaml\n"
        file = configs / "can232.yaml"
        assert (
            said(str(file))
            == f"can-bridge: can232 is not running: {hint.replace('run can232', f'run {file}')}\n"
        )
        with serving(run / "a.sock", snapshot()):
            (run / "a.sock").rename(run / "can232.sock")  # and the one that ends does not find it
        assert said("can232") == said() == f"can-bridge: can232 is not running: {hint}\n"
        monkeypatch.setattr(os, "geteuid", lambda: 1000)
        assert "is not running (only your bridges and root's are seen): start" in said("can232")

    @pytest.mark.usefixtures("configs")
    def test_a_watch_outlives_the_bridge(
        self, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """It is there, away, away, there again; then Ctrl-C."""
        bridge = contextlib.ExitStack()
        start: Callable[[], Any] = lambda: bridge.enter_context(serving(run / "can232.sock", snapshot()))  # noqa: E731
        steps = iter([bridge.close, lambda: None, start, bridge.close])

        def sleep(_seconds: float) -> None:
            step = next(steps, None)
            if step is None:
                raise KeyboardInterrupt
            step()

        monkeypatch.setattr(cli.time, "sleep", sleep)
        start()
        assert cli.main(["status", "--watch", "can232"]) == 130
        heads = [line for line in capsys.readouterr().out.splitlines() if line.startswith("can232")]
        away = "can232 is not running: start it with `can-bridge run can232` or …"
        assert [head[: len(away) - 1] for head in heads] == [
            "can232: running, up 9 s",
            away[:-1],
            away[:-1],
            "can232: running, up 9 s",
            away[:-1],
        ]
        assert all(head.endswith("; waiting for it") for head in heads if "not running" in head)

    @pytest.mark.usefixtures("configs")
    def test_programs_that_watch_get_objects_only(
        self, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        bridge = contextlib.ExitStack()
        steps = iter([lambda: None, bridge.close, lambda: None])

        def sleep(_seconds: float) -> None:
            step = next(steps, None)
            if step is None:
                raise KeyboardInterrupt
            step()

        monkeypatch.setattr(cli.time, "sleep", sleep)
        bridge.enter_context(serving(run / "can232.sock", snapshot()))
        assert cli.main(["status", "--watch", "--json", "can232"]) == 130
        out, err = capsys.readouterr()
        assert [json.loads(line)["name"] for line in out.splitlines()] == ["can232", "can232"]
        assert err.count("can232 is not running") == 1

    def test_a_small_terminal_shows_the_head(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(os, "get_terminal_size", lambda _fd: os.terminal_size((20, 4)))
        monkeypatch.setattr(sys.stdout, "fileno", lambda: 1, raising=False)
        text = cli._fitted(status_text.render(snapshot(state="waiting", reason="there is no tty")))
        assert text.splitlines() == ["can232: waiting, up ", "9 s", "  reason      there "]


class TestInterface:
    """`can-bridge interface`; that it makes one: tests/system/test_privileges.py."""

    @pytest.fixture
    def made(self, monkeypatch: pytest.MonkeyPatch) -> list[str]:
        names: list[str] = []

        def make(channel: str) -> bool:
            names.append(channel)
            return len(names) == 1

        monkeypatch.setattr(socketcan, "make_interface", make)
        return names

    def test_by_its_name(self, configs: Path, made: list[str], capsys: pytest.CaptureFixture[str]) -> None:
        assert [cli.main(["interface", "vcan7"]) for _ in range(2)] == [0, 0]
        assert (made, capsys.readouterr().out) == (["vcan7"] * 2, "vcan7: is up\nvcan7: was up before\n")
        assert cli.main(["interface", str(configs / "vcan7.yaml")]) == 78  # a file that is not there
        assert made == ["vcan7"] * 2

    @pytest.mark.parametrize("create", [True, False])
    def test_by_a_configuration(
        self, configs: Path, made: list[str], capsys: pytest.CaptureFixture[str], create: bool
    ) -> None:
        file = configs / "can232.yaml"
        bus = f"{{channel: vcan7, create: {str(create).lower()}}}"
        file.write_text(CONFIG.replace("{interface: virtual, channel: a}", bus))
        for name in ("can232", str(file)):
            assert cli.main(["interface", name]) == 0
        assert made == ["vcan7"] * 2 * create
        if not create:
            line = f"vcan7: not made, since {file} does not say create: true\n"
            assert capsys.readouterr().out == line * 2

    def test_one_that_cannot_be(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert cli.main(["interface", "vcan 7"]) == 1
        assert capsys.readouterr().err.startswith("can-bridge: 'vcan 7' is no name of an interface")


class TestUser:
    """`run --user`: the interface is opened before root is given up, once."""

    BUS = BusConfig(channel="vcan0", create=True)

    def opened(
        self, monkeypatch: pytest.MonkeyPatch, found: list[Any]
    ) -> tuple[Callable[..., Any], list[str]]:
        done: list[str] = []

        def open_interface(*_arguments: Any, **options: Any) -> Any:
            done.append(f"create={options['create']}")
            one = found.pop(0)
            if isinstance(one, InterfaceError):
                raise one
            return one

        monkeypatch.setattr(interfaces, "open_interface", open_interface)
        monkeypatch.setattr(privileges, "become", lambda user: done.append(f"become {user}"))
        return cli._opened_as("65532", self.BUS), done

    def test_the_first_is_open_already(self, monkeypatch: pytest.MonkeyPatch) -> None:
        open_interface, done = self.opened(monkeypatch, ["first", "second"])
        assert done == ["create=True", "become 65532"]
        assert [open_interface("socketcan", "vcan0", create=False, options={}) for _ in range(2)] == [
            "first",
            "second",
        ]
        assert done[2:] == ["create=False"]

    def test_an_error_is_told_by_the_bridge(self, monkeypatch: pytest.MonkeyPatch) -> None:
        open_interface, done = self.opened(monkeypatch, [InterfaceError("vcan0: no"), "second"])
        assert done == ["create=True", "become 65532"]
        with pytest.raises(InterfaceError, match="vcan0: no"):
            open_interface("socketcan", "vcan0", create=True, options={})
        assert open_interface("socketcan", "vcan0", create=True, options={}) == "second"


class TestProbes:
    """`status --check`, as a container engine runs it: an exit status and one line."""

    @pytest.mark.parametrize(
        ("changes", "holding", "because"),
        [
            ({}, {"started", "ready", "live"}, "running"),
            (
                {"state": "waiting", "reason": "/dev/ttyUSB0: does not exist"},
                {"started", "live"},
                "waiting (/dev/ttyUSB0: does not exist)",
            ),
            ({"state": "bus-off"}, {"started", "live"}, "bus-off"),
            (
                {"bus": snapshot()["bus"] | {"up": False}, "reason": "interface vcan0 is down"},
                {"live"},
                "running (interface vcan0 is down)",
            ),
            (
                {"state": "idle", "bus": {"open": False, "up": False}, "reason": "bus not open: x\n"},
                {"live"},
                "idle (bus not open: x\\n)",
            ),
        ],
        ids=["running", "no adapter", "bus-off", "interface down", "no interface"],
    )
    def test_the_three(
        self,
        run: Path,
        capsys: pytest.CaptureFixture[str],
        changes: dict[str, Any],
        holding: set[str],
        because: str,
    ) -> None:
        with serving(run / "can232.sock", snapshot() | changes):
            for probe in cli.PROBES:
                holds = probe in holding
                assert cli.main(["status", "--check", probe]) == (0 if holds else 1)
                line = f"can232: {probe if holds else f'not {probe}'}, {because}\n"
                assert capsys.readouterr() == (line, "")

    def test_of_several_the_worst_counts(self, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
        waiting = snapshot("b", state="waiting")
        with serving(run / "a.sock", snapshot("a")), serving(run / "b.sock", waiting):
            assert cli.main(["status", "--check", "started"]) == 0
            assert capsys.readouterr().out == "a: started, running\nb: started, waiting\n"
            assert cli.main(["status", "--check", "ready"]) == 1
            assert cli.main(["status", "--check", "ready", "a"]) == 0
            (run / "b.sock").rename(run / "c.sock")
            (run / "b.sock").touch()
            capsys.readouterr()
            assert cli.main(["status", "--check", "live"]) == 3
        out = capsys.readouterr().out
        assert out.startswith(f"a: live, running\nb: not live: no bridge answers on {run}/b.sock: ")

    @pytest.mark.usefixtures("run", "configs")
    def test_nobody_answers(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert cli.main(["status", "--check", "live", "can232"]) == 3
        assert capsys.readouterr().err.startswith("can-bridge: can232 is not running: start it")

    def test_costs_a_moment(self, run: Path) -> None:
        """It runs every few seconds: nothing that it can do without is loaded. 0.04 s in all."""
        script = (
            "import sys; from bridged import cli; cli.main(sys.argv[1:]); "
            "print({*sys.modules} & {'msgspec', 'yaml', 'asyncio', 'subprocess', 'can', 'serial', 'usb'})"
        )
        with serving(run / "can232.sock", snapshot()):
            command = ["status", "--check", "live", "--socket", str(run / "can232.sock")]
            done = subprocess.run(
                [sys.executable, "-P", "-c", script, *command], capture_output=True, text=True, check=True
            )
        assert done.stdout == "can232: live, running\nset()\n"


def test_a_stop_before_the_start_is_heard(tmp_path: Path) -> None:
    """Process 1 of a container never gets a SIGTERM that it has no handler for: it would go on."""
    file = tmp_path / "a.yaml"
    file.write_text(CONFIG)
    script = (
        "import os, signal, sys; from bridged import cli; "
        "cli._given = lambda _: os.kill(os.getpid(), signal.SIGTERM); "
        "sys.exit(cli.main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", script, "run", str(file)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


class TestPipes:
    def can_bridge(
        self, *arguments: str, redirect: str, **environment: str
    ) -> subprocess.CompletedProcess[str]:
        """Its exit status is that of can-bridge, not that of the pipe."""
        python = [sys.executable, "-m", "bridged"]
        return subprocess.run(
            ["bash", "-o", "pipefail", "-c", f'"$@" {redirect}', "bash", *python, *arguments],
            capture_output=True,
            check=False,
            env={name: text for name, text in os.environ.items() if name != "PYTHONUNBUFFERED"} | environment,
            text=True,
            timeout=60,
        )

    @pytest.mark.parametrize("environment", [{}, {"PYTHONUNBUFFERED": "1"}], ids=["buffered", "unbuffered"])
    @pytest.mark.parametrize("command", [["--help"], ["check", "FILE"], ["status", "--socket", "SOCKET"]])
    def test_a_full_disk_is_told_once(
        self, tmp_path: Path, command: list[str], environment: dict[str, str]
    ) -> None:
        (tmp_path / "one.yaml").write_text(CONFIG)
        paths = {"FILE": str(tmp_path / "one.yaml"), "SOCKET": str(tmp_path / "a.sock")}
        with serving(tmp_path / "a.sock", snapshot()):
            words = [paths.get(word, word) for word in command]
            done = self.can_bridge(*words, redirect=">/dev/full", **environment)
        assert done.stderr == "can-bridge: cannot write to the standard output: No space left on device\n"
        assert done.returncode == 1

    @pytest.mark.parametrize("options", [[], ["--json"]])
    def test_a_reader_that_has_seen_enough_is_no_error(self, tmp_path: Path, options: list[str]) -> None:
        with serving(tmp_path / "a.sock", snapshot()):
            command = ["status", "--watch", "--socket", str(tmp_path / "a.sock"), *options]
            done = self.can_bridge(*command, redirect="| head -n 1")
        assert (done.stderr, done.returncode) == ("", 1)

    def test_closed_streams(self, tmp_path: Path) -> None:
        (tmp_path / "one.yaml").write_text(CONFIG)
        done = self.can_bridge("check", str(tmp_path / "one.yaml"), redirect="0<&- >&-")
        assert (done.stderr, done.returncode) == ("", 0)
        done = self.can_bridge("check", str(tmp_path / "none.yaml"), redirect="2>&-")
        assert (done.stdout, done.returncode) == ("", 78)

    def test_a_name_in_no_encoding(self, tmp_path: Path) -> None:
        path = tmp_path / "br\udcfccke.yaml"
        done = self.can_bridge("check", str(path), redirect="")
        assert done.stderr.startswith(rf"{tmp_path}/br\xfccke.yaml: ")
        path.write_text(CONFIG)
        done = self.can_bridge("check", str(path), redirect="")
        assert done.stdout.startswith(rf"{tmp_path}/br\xfccke.yaml: ")
        assert (done.stderr, done.returncode) == ("", 0)
