"""What the bridge says of other programs that have its adapter's port open."""

import os
import subprocess
import time
from pathlib import Path

import pytest
from benches.bridge import Bench, run_until, started, stopped

from bridged.ports import sharing, sysfs
from bridged.ports.sharing import PAUSE_S, SETTLED_S, Sharing
from bridged.simulators.can232 import Can232


def test_a_program_without_a_lock_is_named(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """And neither the simulator, which has its own terminal open, nor the bridge itself."""
    monkeypatch.setattr(sharing, "SETTLED_S", 0.0)
    bench.plug_in(Can232(time.monotonic()))
    line = os.open(bench.link, os.O_RDWR | os.O_NOCTTY)
    with subprocess.Popen(["sleep", "60"], stdin=line) as sleep:
        os.close(line)
        try:
            bridge = started(bench.bridge())
            run_until(bridge, lambda: "is also open in" in caplog.text)
            stopped(bridge)
        finally:
            sleep.kill()
    assert f"{bench.link} is also open in sleep (process {sleep.pid}): each gets a part" in caplog.text


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """What is found when the port is looked for; the last one is what is found now, the length how often."""
    found: list[list[str]] = [[]]

    def users(_path: Path, *, others: bool) -> list[str]:
        assert others
        found.append(found[-1])
        return found[-1]

    monkeypatch.setattr(sysfs, "users", users)
    return found


def test_one_look_after_the_start_and_one_at_a_sign(
    looks: list[list[str]], caplog: pytest.LogCaptureFixture
) -> None:
    shared = Sharing()
    shared.suspect(0.0)  # nothing is open
    shared.opened("/dev/ttyUSB0", 0.0)
    shared.on_timer(SETTLED_S - 0.1)
    assert len(looks) == 1
    shared.on_timer(SETTLED_S)
    assert shared.next_at is None
    shared.suspect(SETTLED_S + PAUSE_S - 0.1)  # too soon
    assert len(looks) == 2
    assert not caplog.records

    looks.append(["cat (process 7)"])
    for n in range(1, 4):  # told once
        shared.suspect(SETTLED_S + n * PAUSE_S)
    assert len(looks) == 6
    assert [record.getMessage().split(":")[0] for record in caplog.records] == [
        "/dev/ttyUSB0 is also open in cat (process 7)"
    ]
    shared.closed()
    shared.suspect(100.0)
    assert len(looks) == 6


def test_a_network_port_has_no_other_users_here(looks: list[list[str]]) -> None:
    shared = Sharing()
    shared.opened("socket://h:1", 0.0)
    shared.suspect(0.0)
    assert shared.next_at is None
    assert len(looks) == 1
