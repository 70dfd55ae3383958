"""The process: signals, reload, what systemd is told. systemd itself is in tests/system/test_systemd.py."""

import fcntl
import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bridged import VERSION
from bridged.bridge import interface as interface_module
from bridged.bridge.bridge import Bridge
from bridged.bridge.lifecycle import State
from bridged.config import load
from bridged.daemon import service
from bridged.daemon.eeprom_store import FileMemory
from bridged.daemon.notify import Notifier
from bridged.daemon.service import Service
from bridged.errors import InterfaceError
from bridged.interfaces import open_interface
from bridged.interfaces.base import OpenInterface
from bridged.interfaces.python_can import open_python_can
from bridged.settings import Config, Restart

DEADLINE_S = 20.0
RUNNING = "running: USB2CAN HW0003FW0016 RIG0001 on /dev/ttyUSB0, vcan0"
CONFIG = """\
adapter: {{type: can232, port: {port}, baudrate: 115200}}
channel: {{bitrate: 125000}}
bus: {{interface: virtual, channel: {bus}}}
transmit: {{deadline: {deadline}}}
"""
# As systemd-python's; its own would do, but need not be installed.
DAEMON = """\
import os, socket
def notify(text):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
        out.sendto(text.encode(), os.environ["NOTIFY_SOCKET"])
"""


def write_config(path: Path, *, port: str = "/nowhere/tty", bus: str = "a", deadline: float = 1.0) -> Path:
    path.write_text(CONFIG.format(port=port, bus=bus, deadline=deadline))
    return path


class Systemd:
    """What systemd hears."""

    def __init__(self, directory: Path) -> None:
        self.path = directory / "notify"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.settimeout(DEADLINE_S)
        self._socket.bind(str(self.path))

    def hear(self) -> str:
        """The next message but for the watchdog's."""
        while (text := self._socket.recv(4096).decode()) == "WATCHDOG=1":
            pass
        return text

    def wait_for(self, start: str) -> list[str]:
        """All messages up to the one that begins like this, that one included."""
        heard = [self._socket.recv(4096).decode()]
        while not heard[-1].startswith(start):
            heard.append(self._socket.recv(4096).decode())
        return heard

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[Systemd]:
    made = Systemd(tmp_path)
    yield made
    made.close()


class TestProcess:
    """`can-bridge run` as systemd starts it, without an adapter."""

    @pytest.fixture
    def start(self, tmp_path: Path, systemd: Systemd) -> Iterator[Callable[..., subprocess.Popen[str]]]:
        package = tmp_path / "fake/systemd"
        package.mkdir(parents=True)
        (package / "__init__.py").touch()
        (package / "daemon.py").write_text(DAEMON)
        started = []

        def start(file: Path, redirect: str = "", **environment: str) -> subprocess.Popen[str]:
            process = subprocess.Popen(
                [
                    "sh",
                    "-c",
                    f'exec "$@" {redirect}',
                    "sh",
                    sys.executable,
                    "-m",
                    "bridged",
                    "run",
                    str(file),
                    "--socket",
                    str(tmp_path / "status.sock"),
                ],
                env={k: v for k, v in os.environ.items() if k != "JOURNAL_STREAM"}
                | {
                    "NOTIFY_SOCKET": str(systemd.path),
                    "PYTHONPATH": str(package.parent),
                    "STATE_DIRECTORY": str(tmp_path),
                    **environment,
                },
                stderr=subprocess.PIPE,
                text=True,
            )
            started.append(process)
            return process

        yield start
        for process in started:
            process.kill()
            process.communicate()

    def test_ready_without_an_adapter_and_stopped(
        self, tmp_path: Path, systemd: Systemd, start: Callable[..., subprocess.Popen[str]]
    ) -> None:
        process = start(write_config(tmp_path / "one.yaml"))
        assert systemd.wait_for("READY=1")[-1] == "READY=1"
        waiting = systemd.wait_for("STATUS=waiting: ")[-1]
        assert "/nowhere/tty: does not exist" in waiting
        process.terminate()
        assert systemd.hear() == "STOPPING=1"
        _, log = process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 0
        lines = log.splitlines()
        first = f"one: can-bridge {VERSION}: {tmp_path}/one.yaml: can232 on /nowhere/tty to virtual a"
        assert lines[0].endswith(first)
        last = r" one: stopped after \d s: 0 frames received, 0 sent; none dropped; no adapter was reached$"
        assert re.search(last, lines[-1])

    def test_a_stop_ends_well_whatever_comes_after_it(
        self, tmp_path: Path, systemd: Systemd, start: Callable[..., subprocess.Popen[str]]
    ) -> None:
        process = start(write_config(tmp_path / "one.yaml"))
        systemd.wait_for("STATUS=waiting: ")
        process.terminate()
        while process.poll() is None:
            process.send_signal(signal.SIGHUP)
        assert process.returncode == 0

    @pytest.mark.parametrize(
        ("redirect", "closed"), [("2>&-", (2,)), ("2>/dev/full", ()), ("0<&- 1>&- 2>&-", (0, 1, 2))]
    )
    def test_it_runs_without_anybody_to_talk_to(
        self,
        tmp_path: Path,
        systemd: Systemd,
        start: Callable[..., subprocess.Popen[str]],
        redirect: str,
        closed: tuple[int, ...],
    ) -> None:
        process = start(write_config(tmp_path / "one.yaml"), redirect)
        systemd.wait_for("STATUS=waiting: ")
        for fd in closed:  # or a port might get the number, and what Python says last
            assert str(Path(f"/proc/{process.pid}/fd/{fd}").readlink()) == os.devnull
        process.terminate()
        assert process.wait(DEADLINE_S) == 0

    def test_reload(
        self, tmp_path: Path, systemd: Systemd, start: Callable[..., subprocess.Popen[str]]
    ) -> None:
        file = write_config(tmp_path / "one.yaml")
        process = start(file)
        systemd.wait_for("STATUS=waiting: /nowhere/tty")

        process.send_signal(signal.SIGHUP)
        assert systemd.hear().startswith("RELOADING=1\nMONOTONIC_USEC=")
        assert systemd.hear() == "READY=1"

        file.write_text(file.read_text().replace("bitrate", "bitrat"))
        process.send_signal(signal.SIGHUP)
        heard = systemd.wait_for("STATUS=")
        assert [text.partition("\n")[0] for text in heard[:-1]] == ["RELOADING=1", "READY=1"]
        assert heard[-1].startswith("STATUS=waiting: /nowhere/tty")
        assert f"reload refused: {file}:2:1: channel.bitrate" in heard[-1]

        write_config(file, port="/nowhere/other")
        process.send_signal(signal.SIGHUP)
        heard = systemd.wait_for("STATUS=waiting: /nowhere/other")
        kinds = [text.partition("\n")[0] for text in heard if not text.startswith("STATUS")]
        assert kinds == ["RELOADING=1", "READY=1"]
        assert "refused" not in heard[-1]

        process.terminate()
        systemd.wait_for("STOPPING=1")
        _, log = process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 0
        assert "reload: nothing has changed" in log
        assert f"reload refused: {file}:2:11: channel.bitrat" in log
        assert log.count("bus open") == 1

    def test_a_command_is_told_of_the_state_and_does_not_delay_the_end(
        self, tmp_path: Path, systemd: Systemd, start: Callable[..., subprocess.Popen[str]]
    ) -> None:
        fifo = tmp_path / "fifo"
        os.mkfifo(fifo)
        script = f"exec >{fifo}; trap '' TERM; echo $CAN_BRIDGE_NAME is $CAN_BRIDGE_STATE; sleep 1000; true"
        file = write_config(tmp_path / "one.yaml")
        process = start(file)
        systemd.wait_for("STATUS=waiting: ")
        file.write_text(f"{file.read_text()}notify: {json.dumps(['sh', '-c', script])}\n")
        process.send_signal(signal.SIGHUP)
        with fifo.open() as told:
            assert told.readline() == "one is waiting\n"
            process.terminate()
            assert told.read() == ""  # nobody is left who could write
        _, log = process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 0
        assert "the adapter stays open" in log

    def test_the_watchdog_is_fed(
        self, tmp_path: Path, systemd: Systemd, start: Callable[..., subprocess.Popen[str]]
    ) -> None:
        file = write_config(tmp_path / "one.yaml")
        assert start(file, WATCHDOG_USEC="100000")
        for _ in range(3):
            systemd.wait_for("WATCHDOG=1")

    def test_without_systemd_python_it_says_so(
        self, tmp_path: Path, start: Callable[..., subprocess.Popen[str]]
    ) -> None:
        (tmp_path / "fake/systemd/daemon.py").unlink()
        (tmp_path / "fake/systemd/daemon").mkdir()  # a package without notify()
        process = start(write_config(tmp_path / "one.yaml"))
        _, log = process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 78
        assert "apt install python3-systemd" in log


class TestSignals:
    @pytest.fixture
    def made(self) -> tuple[Service, list[str]]:
        done: list[str] = []
        bridge: Any = SimpleNamespace(
            config=None, state=State.RUNNING, finished=False, stop=lambda: done.append("stop")
        )

        def successor(_present: Any) -> None:
            done.append("reload")

        return Service(bridge, None, successor), done

    def test_many_are_one_reload(self, made: tuple[Service, list[str]]) -> None:
        running, done = made
        with service._signals() as (reader, came):
            for _ in range(100):
                os.kill(os.getpid(), signal.SIGHUP)
            running._on_signals(reader, came)
            assert (done, came) == (["reload"], set())
            with pytest.raises(BlockingIOError):
                os.read(reader, 1)

    @pytest.mark.parametrize(
        ("then", "done"),
        [
            # A file that is what it was is no change of the bridge that runs, but of the one that would come.
            (signal.SIGHUP, ["first?", "stop", "second?", "second closed", "stop"]),
            (signal.SIGTERM, ["first?", "stop", "second closed", "stop"]),
        ],
    )
    def test_while_a_reload_waits_for_the_old_bridge(self, then: signal.Signals, done: list[str]) -> None:
        did: list[str] = []
        bridge: Any = SimpleNamespace(
            config="first",
            state=State.RUNNING,
            stop=lambda *_: did.append("stop"),
            reconfigure=lambda _: False,
        )

        def successor(present: Any) -> Any:
            did.append(f"{present}?")
            config = "second" if present == "first" else "first"
            return SimpleNamespace(config=config, close=lambda: did.append(f"{config} closed"))

        running = Service(bridge, None, successor)
        with service._signals() as (reader, came):
            for number in (signal.SIGHUP, then):
                os.kill(os.getpid(), number)
                running._on_signals(reader, came)
        assert did == done

    def test_a_stop_comes_first_also_if_its_number_finds_no_place(
        self, made: tuple[Service, list[str]]
    ) -> None:
        running, done = made
        with service._signals() as (reader, came):
            for _ in range(fcntl.fcntl(reader, fcntl.F_SETPIPE_SZ, 4096) + 1):
                os.kill(os.getpid(), signal.SIGHUP)
            os.kill(os.getpid(), signal.SIGTERM)
            running._on_signals(reader, came)
        assert done == ["stop"]


class TestReload:
    @pytest.fixture
    def opened(self) -> list[OpenInterface]:
        """The interfaces that bridges have opened."""
        return []

    @pytest.fixture
    def running(self, tmp_path: Path, opened: list[OpenInterface]) -> tuple[Service, Path, list[str]]:
        """A service in this process; the test's own thread is the one that runs it."""
        file = write_config(tmp_path / "one.yaml", bus=tmp_path.name)
        memory = FileMemory(tmp_path)
        heard: list[str] = []

        def noted(*arguments: Any, **options: Any) -> OpenInterface:
            opened.append(open_interface(*arguments, **options))
            return opened[-1]

        def bridge(config: Config) -> Bridge:
            return Bridge(config, memory, open_interface=noted)

        def successor(present: Any) -> Bridge | None:
            fresh = load(file)
            return None if fresh == present else bridge(fresh)

        return Service(bridge(load(file)), Notifier(heard.append), successor), file, heard

    def run(self, running: Service, steps: list[Callable[[], None]], heard: list[str]) -> None:
        """Performs a step each time that READY=1 was said, then stops it."""

        def perform() -> None:
            end = time.monotonic() + DEADLINE_S
            for n, step in enumerate(steps, 1):
                while heard.count("READY=1") < n and time.monotonic() < end:
                    threading.Event().wait(0.01)
                step()

        thread = threading.Thread(target=perform)
        thread.start()
        running.run()
        thread.join()

    def test_the_bus_stays_open_if_its_section_has_not_changed(
        self, running: tuple[Service, Path, list[str]], opened: list[OpenInterface]
    ) -> None:
        made, file, heard = running
        first = made.bridge

        def change() -> None:
            write_config(file, port="/nowhere/other", bus=file.parent.name)
            os.kill(os.getpid(), signal.SIGHUP)

        self.run(made, [change, lambda: os.kill(os.getpid(), signal.SIGTERM)], heard)
        assert made.bridge is not first
        assert made.bridge.config.adapter.port == "/nowhere/other"
        assert len(opened) == 1
        assert first.filenos()[1] == -1  # nothing of the first is left open

    def test_the_adapter_stays_open_if_it_need_not_know(
        self, running: tuple[Service, Path, list[str]], caplog: pytest.LogCaptureFixture
    ) -> None:
        caplog.set_level(logging.INFO)
        made, file, heard = running
        first = made.bridge

        def change() -> None:
            text = write_config(file, bus=file.parent.name, deadline=2.0).read_text()
            settings = "health: {interval: 0.5}\nreconnect: {initial: 2.0}\n"
            file.write_text(text.replace("}\nbus", ", restart: never}\nbus") + settings)
            os.kill(os.getpid(), signal.SIGHUP)

        self.run(made, [change, lambda: os.kill(os.getpid(), signal.SIGTERM)], heard)
        assert made.bridge is first
        assert "reload: the configuration has changed, the adapter stays open" in caplog.messages
        config = first.config
        assert (config.transmit.deadline_s, config.health.interval_s) == (2.0, 0.5)
        assert (config.reconnect.initial_s, config.channel.restart) == (2.0, Restart.NEVER)

    def test_another_bus_is_opened(self, running: tuple[Service, Path, list[str]]) -> None:
        made, file, heard = running

        def change() -> None:
            write_config(file, bus=file.parent.name + "b")
            os.kill(os.getpid(), signal.SIGHUP)

        self.run(made, [change, lambda: os.kill(os.getpid(), signal.SIGTERM)], heard)
        assert made.bridge.config.bus.channel.endswith("b")
        assert made.bridge.state is State.STOPPED

    def test_a_stop_ends_a_reload(self, running: tuple[Service, Path, list[str]]) -> None:
        """Whichever of the two bridges it meets."""
        made, file, heard = running

        def both() -> None:
            write_config(file, port="/nowhere/other")
            os.kill(os.getpid(), signal.SIGHUP)
            os.kill(os.getpid(), signal.SIGTERM)

        self.run(made, [both], heard)
        assert made.bridge.finished
        assert heard[-1] == "STATUS=stopping"

    def test_without_a_successor_sighup_stops(self, tmp_path: Path) -> None:
        file = write_config(tmp_path / "one.yaml", bus=tmp_path.name)
        heard: list[str] = []
        made = Service(Bridge(load(file), FileMemory(tmp_path)), Notifier(heard.append))
        self.run(made, [lambda: os.kill(os.getpid(), signal.SIGHUP)], heard)
        assert made.bridge.state is State.STOPPED


class TestReady:
    @pytest.fixture
    def heard(self) -> list[str]:
        return []

    @pytest.fixture
    def waiting(self, heard: list[str]) -> Service:
        """A service in its first five seconds."""
        bridge: Any = SimpleNamespace()
        made = Service(bridge, Notifier(heard.append))
        made._ready_at = 100.0 + service.READY_LIMIT_S
        return made

    def test_when_the_interface_is_open(self, waiting: Service, heard: list[str]) -> None:
        waiting._tell_ready(100.1, "", interface_open=False)
        assert heard == []
        waiting._tell_ready(100.2, "", interface_open=True)
        waiting._tell_ready(200.0, "vcan0 was deleted", interface_open=False)
        assert heard == ["READY=1"]

    def test_after_five_seconds_without_it(
        self, waiting: Service, heard: list[str], caplog: pytest.LogCaptureFixture
    ) -> None:
        for now in (104.9, 105.0, 106.0):
            waiting._tell_ready(now, "bus not open: vcan0: there is no such interface", interface_open=False)
            assert heard == ["READY=1"] * (now >= 105.0)
        (record,) = caplog.records
        assert record.levelno == logging.ERROR
        assert "there is no such interface" in record.getMessage()

    def test_the_loop_wakes_for_it_and_goes_on_trying(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(service, "READY_LIMIT_S", 0.01)
        monkeypatch.setattr(interface_module, "RETRY_S", 0.05)
        opened: list[object] = []

        def open_interface(*arguments: Any, **_options: Any) -> OpenInterface:
            opened.append(arguments)
            if len(opened) < 3:
                raise InterfaceError("vcan0: there is no such interface")
            return open_python_can("virtual", tmp_path.name, {})

        heard: list[str] = []

        def notified(text: str) -> None:
            heard.append(text)
            if text.startswith("STATUS=waiting: /nowhere"):
                os.kill(os.getpid(), signal.SIGTERM)

        config = load(write_config(tmp_path / "one.yaml"))
        bridge = Bridge(config, FileMemory(tmp_path), open_interface=open_interface)
        Service(bridge, Notifier(notified)).run()
        assert heard[:2] == ["STATUS=bus not open: vcan0: there is no such interface", "READY=1"]
        assert heard.count("READY=1") == 1
        assert len(opened) == 3


class TestWatchdog:
    def test_fed_only_if_the_relay_turns(self, caplog: pytest.LogCaptureFixture) -> None:
        heard: list[str] = []
        turned = True
        bridge: Any = SimpleNamespace(finished=False, has_turned=lambda: turned)
        made = Service(bridge, Notifier(heard.append, 5.0))
        made._feed(0.0)
        assert heard == []  # not ready yet
        made._notifier.feed_at = 0.0
        made._feed(0.0)
        made._feed(4.9)
        assert heard == ["WATCHDOG=1"]
        turned = False
        made._feed(5.0)
        assert heard == ["WATCHDOG=1"]
        assert "the relay hangs" in caplog.text
        turned = True
        made._feed(10.0)
        assert heard == ["WATCHDOG=1"] * 2


@pytest.mark.parametrize(
    ("state", "reason", "interface_open", "line"),
    [
        (State.RUNNING, "", True, RUNNING),
        (State.RUNNING, "vcan0 is down", True, f"{RUNNING}, but vcan0 is down"),
        (State.WAITING, "it does not exist", True, "waiting: it does not exist"),
        (State.BACKOFF, "no answer", True, "waiting: no answer"),
        (State.FAULT, "the wrong one", True, "fault: the wrong one"),
        (State.IDLE, "bus not open: no such interface", False, "bus not open: no such interface"),
        (State.RUNNING, "bus lost: vcan0; opening it again", False, "bus lost: vcan0; opening it again"),
        (State.OPENING, "", True, ""),
        (State.STOPPING, "", True, "stopping"),
    ],
)
def test_status_line(state: State, reason: str, interface_open: bool, line: str) -> None:
    bridge: Any = SimpleNamespace(
        config=SimpleNamespace(
            adapter=SimpleNamespace(type="usb2can", port="/dev/ttyUSB0"), bus=SimpleNamespace(channel="vcan0")
        ),
        adapter=SimpleNamespace(
            identity=SimpleNamespace(version="HW0003FW0016", serial_number="RIG0001"),
        ),
    )
    assert service._describe(bridge, state, reason, interface_open=interface_open) == line


def test_sighup_of_a_terminal_stops_and_of_a_service_reloads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    monkeypatch.setattr(os, "open", lambda *_: os.dup(0))
    assert not service.hangup_means_reload()
    monkeypatch.setenv("NOTIFY_SOCKET", "/run/systemd/notify")
    assert service.hangup_means_reload()
