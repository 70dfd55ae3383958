"""The thread of the relay. What the relay does is in test_relay*.py, and with a bridge in test_bridge*.py."""

from pathlib import Path

import pytest

from bridged.adapters import make_adapter
from bridged.bridge.loop import RelayLoop
from bridged.config import load
from bridged.daemon.eeprom_store import FileMemory


@pytest.fixture
def loop(tmp_path: Path) -> RelayLoop:
    file = tmp_path / "one.yaml"
    file.write_text(
        "adapter: {type: can232, port: /nowhere}\nchannel: {bitrate: 125000}\nbus: {channel: vcan0}\n"
    )
    config = load(file)
    return RelayLoop(config, make_adapter(config, FileMemory(tmp_path)))


def test_a_relay_that_does_not_run_has_not_turned(loop: RelayLoop) -> None:
    assert loop.has_turned()  # nothing to compare with yet
    assert not loop.has_turned()
    loop.relay.turn(0)
    assert loop.has_turned()


def test_each_question_has_it_turn(loop: RelayLoop) -> None:
    loop.start()
    for _ in range(3):
        while not loop.has_turned():
            pass
    loop.end()
    assert loop.finished


def test_the_end_of_one_that_was_never_started(loop: RelayLoop) -> None:
    loop.end()
    assert loop.finished
