"""A capture: all bytes of a port with time and direction, in a file of its own, at no cost for the bridge."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import re
import select
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from benches.bridge import LIMIT_S, PairPort
from benches.simulating import running

from bridged import cli
from bridged.capture import Capture, escaped
from bridged.config import load
from bridged.errors import PortError
from bridged.ports.watch import Watch
from bridged.settings import Config
from bridged.simulators import make_device
from bridged.simulators.serve import Simulator

CONFIG = """\
adapter: {type: can232, port: /nowhere/tty, baudrate: 115200}
channel: {bitrate: 125000}
bus: {interface: virtual, channel: a}
"""


@pytest.fixture
def config(tmp_path: Path) -> Config:
    path = tmp_path / "config.yaml"
    path.write_text(CONFIG)
    return load(path)


Made = tuple[Capture, PairPort, Any]


@pytest.fixture
def captured() -> Iterator[Callable[..., Made]]:
    """Makes a capture, with a clock that counts; the port behind it; the port before it."""
    with contextlib.ExitStack() as stack:

        def make(path: Path, config: Config, **options: Any) -> Made:
            ticks = itertools.count()
            capture = Capture(path, config, clock=lambda: float(next(ticks)), **options)
            port = PairPort()
            port.product = "X 1"
            seen = capture.opener(config, lambda _port, _rate: port)("/dev/tty", 9600)
            for part in (capture, port.far, seen):
                stack.enter_context(contextlib.closing(part))  # type: ignore[type-var]
            return capture, port, seen

        yield make


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def read(fd: int) -> bytes:
    assert select.select([fd], [], [], LIMIT_S)[0]
    return os.read(fd, 4096)


def test_bytes_and_events_with_direction_and_time(
    captured: Callable[..., Made], tmp_path: Path, config: Config
) -> None:
    path = tmp_path / "capture"
    capture, port, seen = captured(path, config)
    os.write(seen.fd, b"V \\\r\x00\xff")
    assert port.far.recv(99) == b"V \\\r\x00\xff"
    port.far.send(b"V1013\r")
    assert read(seen.fd) == b"V1013\r"
    seen.close()
    seen.close()
    assert port.far.recv(1) == b""  # closed, too
    head, *rest = lines(path)
    assert head.startswith("# can-bridge-capture version=")
    assert " type=can232 baudrate=115200 bitrate=125000 listen_only=no window=1 masked=no started=" in head
    assert "nowhere" not in head
    assert rest == [
        "# 1.000000 opened product=X\\x201",
        "2.000000 > V\\x20\\\\\\r\\x00\\xff",
        "3.000000 < V1013\\r",
        "# 4.000000 closed",
    ]
    capture.close()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize("data", [bytes(range(256)), b"'\"\\x20 \\"])
def test_the_escapes_are_pythons(data: bytes) -> None:
    text = escaped(data)
    assert text.encode().decode("unicode_escape").encode("latin-1") == data
    assert text.isascii()
    assert text.isprintable()
    assert " " not in text


def test_a_long_piece_is_cut_for_mail(captured: Callable[..., Made], tmp_path: Path, config: Config) -> None:
    _, port, seen = captured(tmp_path / "capture", config)
    port.far.send(b"\xff" * 4000)
    got = b""
    while len(got) < 4000:
        got += read(seen.fd)
    seen.close()
    assert max(map(len, lines(tmp_path / "capture"))) < 998
    assert (tmp_path / "capture").read_text().count("\\xff") == 4000


@pytest.mark.parametrize("way", ["read", "write"])
@pytest.mark.parametrize("failure", [None, PortError("unplugged (No such device)")])
def test_a_port_that_is_lost(
    captured: Callable[..., Made], tmp_path: Path, config: Config, failure: PortError | None, way: str
) -> None:
    """The relay sees the end, and the reason is the one without a capture."""
    _, port, seen = captured(tmp_path / "capture", config)
    port.failure = failure  # type: ignore[assignment]
    if way == "write":
        port.far.shutdown(socket.SHUT_RD)
        os.write(seen.fd, b"V\r")
    else:
        port.far.close()
    assert read(seen.fd) == b""
    says = {"read": None, "write": os.strerror(errno.EPIPE)}[way]
    assert str(seen.failure) == str(failure or says)
    seen.close()
    assert [line.split(" ", 2)[2] for line in lines(tmp_path / "capture")[2:]] == [
        f"lost: {failure or says or 'end of file'}",
        "closed",
    ]


def test_a_port_that_takes_nothing_is_closed_all_the_same(
    captured: Callable[..., Made], tmp_path: Path, config: Config
) -> None:
    _, port, seen = captured(tmp_path / "capture", config)
    port._near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(seen.fd, b"V" * 1000)
    start = time.monotonic()
    seen.close()
    assert time.monotonic() - start < 15.0  # it does not hang
    assert not any(thread.is_alive() for thread in seen._threads)
    taken = 0
    while data := port.far.recv(1 << 20):
        taken += len(data)
    assert (tmp_path / "capture").read_text().count("V") == taken  # what the port took, and no more


def test_the_limit(
    captured: Callable[..., Made], tmp_path: Path, config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "capture"
    _, port, seen = captured(path, config, limit=1000)
    for _ in range(100):
        port.far.send(b"t1230\r" * 5)
        assert read(seen.fd) == b"t1230\r" * 5
    seen.close()
    assert lines(path)[-1].endswith("the file has reached its limit")
    assert 900 < path.stat().st_size < 1100
    assert caplog.text.count("has reached its limit and ends; the bridge goes on") == 1


def test_a_full_disk(
    captured: Callable[..., Made], config: Config, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    capture, port, seen = captured(tmp_path / "capture", config)
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, capture._fd)
    os.close(full)
    for _ in range(2):
        port.far.send(b"t1230\r")
        assert read(seen.fd) == b"t1230\r"
    seen.close()
    assert caplog.text.count("ends: No space left on device; the bridge goes on") == 1


def test_no_file_is_overwritten(tmp_path: Path, config: Config) -> None:
    (tmp_path / "there").write_text("mine")
    (tmp_path / "link").symlink_to("elsewhere")
    for name in ("there", "link"):
        with pytest.raises(PortError, match="there is such a file: choose another name"):
            Capture(tmp_path / name, config)
    with pytest.raises(PortError, match="no/where: the capture cannot be written there: No such file"):
        Capture(tmp_path / "no" / "where", config)
    assert (tmp_path / "there").read_text() == "mine"
    assert not (tmp_path / "elsewhere").exists()


def test_a_masked_capture(captured: Callable[..., Made], tmp_path: Path, config: Config) -> None:
    """Also what was cut off; the adapter and the relay get the bytes as they are."""
    path = tmp_path / "capture"
    capture, port, seen = captured(path, config, masked=True)
    os.write(seen.fd, b"t123")
    assert port.far.recv(99) == b"t123"
    port.far.send(b"t12320A0B\r")
    assert read(seen.fd) == b"t12320A0B\r"
    os.write(seen.fd, b"1FF\rT12")
    assert port.far.recv(99) == b"1FF\rT12"
    seen.close()
    assert capture.ids
    other = f"{capture.ids.standard(0x123):03X}"
    assert "masked=yes" in lines(path)[0]
    assert [line.split()[1:] for line in lines(path)[2:]] == [
        ["<", f"t{other}20000\\r"],
        [">", f"t{other}100\\r"],
        [">", "T00"],
        ["7.000000", "closed"],
    ]


def test_a_numbered_terminal_is_known_again() -> None:
    """Also where the descriptor that the bridge has is not its own."""
    master, slave = os.openpty()
    near, far = socket.socketpair()
    watch = Watch(os.ttyname(slave))
    watch.opened(near.fileno())
    watch.refuse_stranger()
    os.close(slave)
    os.close(master)
    with pytest.raises(PortError, match="this terminal has ended"):
        watch.refuse_stranger()
    watch.close()
    near.close()
    far.close()


def wait_for(path: Path, text: str, log: Path) -> None:
    end = time.monotonic() + LIMIT_S
    while not (path.exists() and text in path.read_text()):
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.01)


def test_run_through_a_reload_and_a_kill(tmp_path: Path) -> None:
    """The file is whole at each moment; the second channel is noted as the first."""
    link, config, path, log = (tmp_path / name for name in ("tty", "one.yaml", "capture", "log"))
    text = CONFIG.replace("/nowhere/tty", str(link))
    config.write_text(text)
    command = [sys.executable, "-m", "bridged", "run", str(config), "--socket", str(tmp_path / "socket")]
    command += ["--capture", str(path), "--mask", "--capture-limit", "1"]
    environment = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "nobody"), "STATE_DIRECTORY": str(tmp_path)}
    with (
        running(Simulator(make_device("can232"), link=link)),
        log.open("w") as stderr,
        subprocess.Popen(command, env=environment, stderr=stderr) as process,
    ):
        try:
            wait_for(path, " > O\\r\n", log)
            config.write_text(text.replace("125000", "250000"))
            process.send_signal(signal.SIGHUP)
            wait_for(path, " > S5\\r\n", log)
        finally:
            process.kill()
    rows = lines(path)
    assert "bitrate=125000" in rows[0]
    assert "masked=yes" in rows[0]
    assert all(re.fullmatch(r"# .*|\d+\.\d{6} [<>] [!-~]+", row) for row in rows)
    events = [row.split(" ", 2)[2] for row in rows[1:] if row.startswith("#")]
    assert [event.split()[0] for event in events] == ["opened", "closed", "settings", "opened"]
    assert " bitrate=250000 " in events[2]
    assert f"capture: all bytes from and to the adapter are written to {path}" in log.read_text()


def test_a_capture_that_is_there_already(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "one.yaml"
    config.write_text(CONFIG)
    assert cli.main(["run", str(config), "--capture", str(config)]) == 1
    assert f"{config}: there is such a file: choose another name for the capture" in capsys.readouterr().err
    assert config.read_text() == CONFIG


@pytest.mark.parametrize("options", [["--mask"], ["--capture-limit", "3"]])
def test_options_without_a_capture(
    tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "one.yaml"
    config.write_text(CONFIG)
    assert cli.main(["run", str(config), *options]) == 1
    assert "are for --capture FILE" in capsys.readouterr().err


@pytest.mark.parametrize("limit", ["0", "-1", "x", "10001"])
def test_a_limit_that_is_none(limit: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(["run", "one", "--capture", "x", "--capture-limit", limit])
    assert "expected a whole number from 1 to 10000" in capsys.readouterr().err


def test_it_is_loaded_only_where_it_is_asked_for() -> None:
    code = (
        "import sys, argparse; from bridged import cli; import bridged.bridge.bridge\n"
        "cli._port_opener(argparse.Namespace(capture=None, mask=False, capture_limit=None), None)\n"
        "print([name for name in sys.modules if name in ('bridged.capture', 'bridged.adapters.masks')])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\n"
