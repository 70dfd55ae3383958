"""A configuration in a ConfigMap: another one is noticed, whole, and only there."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bridged.bridge.lifecycle import State
from bridged.daemon.config_map import LOOK_INTERVAL_S, MountedConfig
from bridged.daemon.service import Service
from bridged.errors import ConfigError

NAME = "can-bridge.yaml"


class Volume:
    """As the kubelet makes one: files behind `..data`, which leads to a directory named by the time."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._versions = 0
        self.put("first")
        (folder / NAME).symlink_to(f"..data/{NAME}")

    def put(self, text: str) -> None:
        self._versions += 1
        version = self._folder / f"..2026_11_25_02_30_00.{self._versions}"
        version.mkdir()
        (version / NAME).write_text(text)
        (self._folder / "..data_tmp").symlink_to(version.name)
        (self._folder / "..data_tmp").rename(self._folder / "..data")


@pytest.fixture
def volume(tmp_path: Path) -> Volume:
    return Volume(tmp_path)


def test_another_one_is_noticed_once(tmp_path: Path, volume: Volume) -> None:
    mounted = MountedConfig(tmp_path / NAME)
    assert not mounted.look(100.0)
    assert mounted.next_at == 100.0 + LOOK_INTERVAL_S
    volume.put("second")
    assert not mounted.look(101.0)
    assert [mounted.look(110.0), mounted.look(120.0)] == [True, False]


def test_one_that_came_before_the_first_look(tmp_path: Path, volume: Volume) -> None:
    mounted = MountedConfig(tmp_path / NAME)
    volume.put("second")
    assert mounted.look(0.0)


@pytest.mark.parametrize("linked", [False, True])
def test_a_plain_file_is_not_looked_at(tmp_path: Path, linked: bool) -> None:
    """Not while somebody edits it."""
    file = tmp_path / "a.yaml"
    file.write_text("first")
    path = tmp_path / "b.yaml" if linked else file
    if linked:
        path.symlink_to(file)
    mounted = MountedConfig(path)
    file.with_name("new").write_text("second")
    file.with_name("new").rename(file)
    assert (mounted.next_at, mounted.look(100.0)) == (None, False)


def test_it_is_applied_like_a_reload(
    tmp_path: Path, volume: Volume, caplog: pytest.LogCaptureFixture
) -> None:
    """A broken one is told, and the old one stays in force; a good one after it is taken."""
    file = tmp_path / NAME
    taken: list[str] = []
    bridge: Any = SimpleNamespace(
        config=None, state=State.RUNNING, reconfigure=lambda config: taken.append(config) or True
    )

    def successor(_present: Any) -> Any:
        text = file.read_text()
        if text == "broken":
            raise ConfigError([f"{file}:1:1: broken"])
        return SimpleNamespace(config=text, close=lambda: None)

    service = Service(bridge, None, successor, MountedConfig(file))
    for now, text in enumerate(["", "broken", "", "third"]):
        if text:
            volume.put(text)
        service._look_at_configuration(now * LOOK_INTERVAL_S)
    assert taken == ["third"]
    assert f"reload refused: {file}:1:1: broken" in caplog.text
