"""Where the files of a bridge are, for root, a service, and other users."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from bridged.daemon import directories
from bridged.daemon.status import running_sockets


def test_where_the_status_sockets_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    user = os.geteuid() or 1000
    own = tmp_path / "can-bridge"
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    assert directories.runtime_directories() == {Path("/run/can-bridge")}
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert directories.runtime_directory() == Path("/run/can-bridge")
    assert directories.runtime_directories() == {Path("/run/can-bridge"), own}  # of `run --user`
    monkeypatch.setattr(os, "geteuid", lambda: user)
    assert directories.runtime_directory() == own
    assert directories.runtime_directories() == {Path("/run/can-bridge")}  # it does not exist
    own.mkdir(mode=0o755)
    os.chown(own, user, -1)
    assert directories.runtime_directories() == {Path("/run/can-bridge"), own}
    own.chmod(0o777)
    assert directories.runtime_directories() == {Path("/run/can-bridge")}
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert directories.runtime_directory() == Path(f"/tmp/can-bridge-{user}")


def test_sockets_by_hand_and_of_the_service(tmp_path: Path) -> None:
    for name in ("a.sock", "b/b.sock", "b/other.sock", "c/d/d.sock", "e/e.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert directories.status_sockets(tmp_path) == {tmp_path / "a.sock", tmp_path / "b/b.sock"}
    assert {directories.runtime_directory_of(path) for path in directories.status_sockets(tmp_path)} == {
        tmp_path
    }


def test_a_socket_that_two_directories_show_is_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As in the image: XDG_RUNTIME_DIR is root's directory, and a bridge is called as its own in there."""
    own = tmp_path / "can-bridge"
    own.mkdir()
    socket = own / "can-bridge.sock"
    socket.touch()
    monkeypatch.setattr(directories, "runtime_directories", lambda: {tmp_path, own})
    assert running_sockets() == [socket]


def test_where_the_state_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/a:/var/lib/b")
    assert directories.state_directory() == Path("/var/lib/a")
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert directories.state_directory() == Path("/var/lib/can-bridge")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setenv("XDG_STATE_HOME", "/home/a/state")
    assert directories.state_directory() == Path("/home/a/state/can-bridge")
