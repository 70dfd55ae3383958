"""What is kept of an adapter's settings, and what others can do with the file."""

from __future__ import annotations

import errno
import logging
import os
from pathlib import Path

import pytest

from bridged.daemon.eeprom_store import FileMemory

SERIAL = "A123"


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    made = tmp_path / "state"
    made.mkdir(mode=0o755)
    return made


def test_remembered_across_starts(tmp_path: Path) -> None:
    FileMemory(tmp_path / "new/state").remember(SERIAL, "W", 1)
    FileMemory(tmp_path / "new/state").remember(SERIAL, "X", 0)
    made = FileMemory(tmp_path / "new/state")
    assert (made.recall(SERIAL, "W"), made.recall(SERIAL, "X"), made.recall("B", "W")) == (1, 0, None)
    assert made.recall(SERIAL, "Z") is None


def test_only_the_owner_may_read_it_whatever_the_umask(directory: Path) -> None:
    before = os.umask(0)
    try:
        FileMemory(directory).remember(SERIAL, "W", 1)
    finally:
        os.umask(before)
    assert [path.name for path in directory.iterdir()] == [f"{SERIAL}.json"]
    assert (directory / f"{SERIAL}.json").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("name", [f"{SERIAL}.new", f"{SERIAL}.json"])
def test_a_link_is_not_followed(directory: Path, name: str) -> None:
    victim = directory.parent / "victim.json"
    victim.write_text('{"W": 7}')
    (directory / name).symlink_to(victim)
    made = FileMemory(directory)
    assert made.recall(SERIAL, "W") is None
    made.remember(SERIAL, "W", 1)
    assert victim.read_text() == '{"W": 7}'
    assert made.recall(SERIAL, "W") == 1


def test_a_link_made_in_the_last_moment_is_not_followed(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who may write in the directory makes the link between our two calls: here that always succeeds."""
    victim = directory.parent / "victim.json"
    victim.write_text("{}")
    unlink = os.unlink

    def then_link(name: str, *, dir_fd: int | None = None) -> None:
        try:
            unlink(name, dir_fd=dir_fd)
        finally:
            (directory / f"{SERIAL}.new").symlink_to(victim)

    monkeypatch.setattr(os, "unlink", then_link)
    FileMemory(directory).remember(SERIAL, "W", 1)
    assert victim.read_text() == "{}"


def test_nothing_is_written_where_another_user_is_the_owner(
    directory: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made = FileMemory(directory)
    made.remember(SERIAL, "W", 1)
    owner = directory.stat().st_uid
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    made.remember(SERIAL, "W", 2)
    assert FileMemory(directory).recall(SERIAL, "W") == 1
    assert f"is known until this process ends, since it cannot be remembered in {directory}: b" in caplog.text
    assert caplog.records[-1].levelno == logging.WARNING


def test_what_cannot_be_stored_is_known_in_this_process(
    directory: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """An adapter that comes and goes all night is not written to each time; a read-only root is no alarm."""
    caplog.set_level(logging.INFO)
    made = FileMemory(directory)
    made.remember(SERIAL, "Z", 0)

    def read_only(*_: object, **__: object) -> int:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), f"{SERIAL}.new")

    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", read_only)
        for _ in range(3):
            made.remember(SERIAL, "W", 1)
            made.remember("B", "X", 1)
        assert (made.recall(SERIAL, "W"), made.recall(SERIAL, "Z"), made.recall("B", "X")) == (1, 0, 1)
        assert made.recall("C", "W") is None
    (line,) = caplog.records
    assert (line.levelno, line.getMessage()) == (
        logging.INFO,
        f"what the adapter has stored (W) is known until this process ends, since it cannot be remembered in "
        f"{SERIAL}.new: Read-only file system; another place that lasts: STATE_DIRECTORY=PATH",
    )
    made.remember(SERIAL, "W", 0)  # it can be written again, and all of it is
    assert {setting: FileMemory(directory).recall(SERIAL, setting) for setting in "WZ"} == {"W": 0, "Z": 0}
    assert made.recall(SERIAL, "W") == 0


def test_nothing_is_written_where_others_may_write(directory: Path, caplog: pytest.LogCaptureFixture) -> None:
    directory.chmod(0o777)
    FileMemory(directory).remember(SERIAL, "W", 1)
    assert list(directory.iterdir()) == []
    assert f"chmod go-w {directory}" in caplog.text


@pytest.mark.parametrize(
    "text",
    ["", "[" * 100_000, "{", "[1]", '{"W": "1"}', '{"W": true}', '{"W": 1.5}', '{"W": null}', "\udcff"],
    ids=["empty", "deep", "cut", "list", "text", "bool", "fraction", "null", "binary"],
)
def test_a_file_that_is_none_of_ours_tells_nothing(directory: Path, text: str) -> None:
    (directory / f"{SERIAL}.json").write_bytes(text.encode(errors="surrogateescape"))
    made = FileMemory(directory)
    assert made.recall(SERIAL, "W") is None
    made.remember(SERIAL, "W", 1)
    assert made.recall(SERIAL, "W") == 1


def test_a_fifo_is_not_waited_for(directory: Path, caplog: pytest.LogCaptureFixture) -> None:
    os.mkfifo(directory / f"{SERIAL}.json")
    assert FileMemory(directory).recall(SERIAL, "W") is None
    assert "not a regular file" in caplog.text


def test_it_is_on_the_disk_before_it_takes_the_place_of_the_old_one(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (done.append("fsync"), fsync(fd)))
    monkeypatch.setattr(
        os, "replace", lambda *args, **where: (done.append("replace"), replace(*args, **where))
    )
    FileMemory(directory).remember(SERIAL, "W", 1)
    assert done == ["fsync", "replace"]
