"""Names that appear in directories, as the kernel tells of them."""

from __future__ import annotations

import contextlib
import select
from pathlib import Path

import pytest

from bridged.ports import inotify
from bridged.ports.inotify import Inotify


def test_what_appears_in_a_directory(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    one.mkdir()
    two.mkdir()
    with contextlib.closing(Inotify()) as names:
        assert names.add([one, two, tmp_path / "missing"])
        assert not names.add([one])
        assert names.read() == (set(), False)
        (one / "file").write_text("made, and then written to")
        (one / "draft").symlink_to("file")
        (one / "draft").rename(two / "link")
        (two / "folder").mkdir()
        assert select.select([names], [], [], 0)[0]
        assert names.read() == ({f"{one}/file", f"{one}/draft", f"{two}/link", f"{two}/folder"}, False)
        (one / "file").write_text("written to again")
        (one / "file").chmod(0o600)
        (one / "file").unlink()
        (two / "folder/file").touch()
        assert not select.select([names], [], [], 0)[0]


def test_a_directory_that_goes_and_comes(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    with contextlib.closing(Inotify()) as names:
        assert names.add([folder])
        folder.rmdir()
        assert names.read() == (set(), True)
        folder.mkdir()
        assert names.add([folder])
        (folder / "file").touch()
        assert names.read() == ({f"{folder}/file"}, False)


def test_lost_events_are_told(tmp_path: Path) -> None:
    limit = int(Path("/proc/sys/fs/inotify/max_queued_events").read_text())
    with contextlib.closing(Inotify()) as names:
        names.add([tmp_path])
        for n in range(limit // 2 + 1):
            (tmp_path / f"draft{n}").touch()
            (tmp_path / f"draft{n}").rename(tmp_path / "name")
        paths, others = names.read()
        assert f"{tmp_path}/draft0" in paths
        assert others


def test_a_name_that_is_no_text(tmp_path: Path) -> None:
    name = b"\xff-\xc3\xbc"
    with contextlib.closing(Inotify()) as names:
        names.add([tmp_path])
        Path(tmp_path, name.decode(errors="surrogateescape")).touch()
        (path,) = names.read()[0]
        assert path.encode(errors="surrogateescape").endswith(name)


def test_no_more_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """max_user_instances: 128 in all containers of a user."""
    made: list[Inotify] = []
    monkeypatch.setattr(inotify, "_INIT_FLAGS", -1)  # EINVAL stands for EMFILE
    with pytest.raises(OSError, match="Invalid argument"):
        made.append(Inotify())
    assert not made
