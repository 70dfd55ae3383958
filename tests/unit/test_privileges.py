"""From root to a user without privileges, in processes of their own.

With CAN interfaces: tests/system/test_privileges.py.
"""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridged import cli
from bridged.daemon import privileges
from bridged.errors import BridgeError

AS_DOCKER = ("setpriv", "--bounding-set=-all,+net_admin,+setuid,+setgid", "--inh-caps=-all")
PYTHON = (sys.executable, "-P")
LIMIT_S = 20.0
CONFIG = """\
adapter: {type: can232, port: /nowhere/tty, baudrate: 115200}
channel: {bitrate: 125000}
bus: {interface: virtual, channel: a}
"""


def may_become_another() -> bool:
    """Root, and others may read this package: it is imported piece by piece."""
    command = (
        "setpriv",
        "--reuid=65532",
        "--regid=65532",
        "--clear-groups",
        *PYTHON,
        "-c",
        "import bridged.cli",
    )
    return (
        os.geteuid() == 0
        and shutil.which("setpriv") is not None
        and subprocess.run(command, capture_output=True, check=False).returncode == 0
    )


needs_root = pytest.mark.skipif(not may_become_another(), reason="takes root")


def python(code: str, *arguments: str) -> dict[str, str]:
    """What /proc/self/status says after this."""
    code = f"from bridged.daemon.privileges import become\n{code}\nprint(open('/proc/self/status').read())"
    done = subprocess.run(
        (*AS_DOCKER, *arguments, *PYTHON, "-c", code),
        capture_output=True,
        text=True,
        check=True,
        timeout=LIMIT_S,
    )
    return status_of(done.stdout)


def status_of(text: str) -> dict[str, str]:
    return {key: value.strip() for key, _, value in (line.partition(":") for line in text.splitlines())}


def assert_is_nobody(status: dict[str, str], uid: int, gid: int) -> None:
    assert (status["Uid"].split(), status["Gid"].split()) == ([str(uid)] * 4, [str(gid)] * 4)
    assert {int(status[f"Cap{kind}"], 16) for kind in ("Inh", "Prm", "Eff", "Amb")} == {0}
    assert status["NoNewPrivs"] == "1"


@needs_root
class TestBecome:
    def test_a_number_without_an_account(self) -> None:
        """The groups that the engine gave stay, root's own does not."""
        status = python("become('65532')", "--groups=0,20,777")
        assert_is_nobody(status, 65532, 65532)
        assert status["Groups"].split() == ["20", "777"]

    def test_an_account(self) -> None:
        nobody = pwd.getpwnam("nobody")
        status = python("become('nobody')\nimport os; assert os.environ['HOME'] == '/nonexistent'")
        assert_is_nobody(status, nobody.pw_uid, nobody.pw_gid)

    def test_nothing_to_become(self) -> None:
        """An image with another user may have the same command."""
        status = python("become('65532')", "--reuid=65532", "--regid=65532", "--clear-groups")
        assert status["Uid"].split() == ["65532"] * 4

    def test_without_the_capabilities(self) -> None:
        code = "from bridged.daemon.privileges import become; become('65532')"
        done = subprocess.run(
            ("setpriv", "--bounding-set=-all,+net_admin", "--inh-caps=-all", *PYTHON, "-c", code),
            capture_output=True,
            text=True,
            check=False,
        )
        assert "it takes root with the capabilities SETUID and SETGID" in done.stderr


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """Others may enter it, unlike pytest's."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


def test_no_such_account() -> None:
    with pytest.raises(BridgeError, match="there is no user 'no-one'"):
        privileges.become("no-one")


@needs_root
def test_a_bridge_that_begins_as_root(open_folder: Path) -> None:
    """It keeps nothing, and root of the same container, who has few capabilities, may ask it."""
    file, run = open_folder / "can232.yaml", open_folder / "run"
    file.write_text(CONFIG)
    run.mkdir()
    os.chown(run, 65532, 65532)
    environment = os.environ | {"XDG_RUNTIME_DIR": str(run)}
    bridge = subprocess.Popen(
        (*AS_DOCKER, *PYTHON, "-m", "bridged", "run", "--user", "65532", str(file)), env=environment
    )
    probe = (*AS_DOCKER, *PYTHON, "-m", "bridged", "status", "--check")
    try:
        deadline = time.monotonic() + LIMIT_S
        while not (run / "can-bridge/can232.sock").exists():
            assert bridge.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert_is_nobody(status_of(Path(f"/proc/{bridge.pid}/status").read_text()), 65532, 65532)
        asked = subprocess.run(
            (*probe, "ready"), env=environment, capture_output=True, text=True, check=False
        )
        assert (asked.returncode, asked.stderr) == (1, "")
        assert asked.stdout.startswith("can232: not ready, ")
        for word in set(cli.PROBES) - {"ready"}:
            assert (
                subprocess.run((*probe, word), env=environment, capture_output=True, check=False).returncode
                == 0
            )
    finally:
        bridge.send_signal(signal.SIGTERM)
        assert bridge.wait(LIMIT_S) == 0
