"""The command that is run when the state is another one: when, with what, and what becomes of it."""

from __future__ import annotations

import itertools
import logging
import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bridged import _relay
from bridged.bridge.lifecycle import State
from bridged.can import BusState
from bridged.daemon import state_hook
from bridged.daemon.state_hook import LIMIT_S, PAUSE_MAX_S, PAUSE_S, REST_S, SETTLE_S, Change, StateHook
from bridged.ports import open_port

COMMAND = ("tell",)
RUNNING = Change("running", "error-active", "", "pc", "vcan0")
PASSIVE = RUNNING._replace(bus_state="error-passive")
AWAY = Change("waiting", "", "/dev/ttyUSB0: does not exist", "pc", "vcan0")


class Started:
    """Stands for commands that end at once: what they were told, and when."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.told: list[tuple[float, Change]] = []
        self.now = 0.0
        self._hook = StateHook()
        monkeypatch.setattr(state_hook, "_spawn", self._spawn)
        ended = SimpleNamespace(si_code=os.CLD_EXITED, si_status=0)
        monkeypatch.setattr(state_hook.os, "waitid", lambda *_: ended)
        monkeypatch.setattr(state_hook.os, "waitpid", lambda *_: None)
        monkeypatch.setattr(state_hook.os, "killpg", lambda *_: None)

    def _spawn(self, _command: tuple[str, ...], change: Change) -> int:
        self.told.append((self.now, change))
        return 1

    def live(self, seconds: float, *changes: Change | None) -> None:
        """In turns of 0.1 s, in each of these states for one turn and in the last for so long."""
        end = self.now + seconds
        left = [*changes]
        while self.now < end - 1e-6:
            self._hook.look(COMMAND, left.pop(0) if len(left) > 1 else left[0], self.now)
            self.now = round(self.now + 0.1, 6)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Started:
    return Started(monkeypatch)


def test_each_state_once(started: Started) -> None:
    started.live(10, RUNNING)
    started.live(10, AWAY)
    assert started.told == [(SETTLE_S, RUNNING), (10 + SETTLE_S, AWAY)]


def test_another_bus_state_is_a_change_and_other_words_are_none(started: Started) -> None:
    started.live(10, RUNNING)
    started.live(10, RUNNING._replace(reason="frames go in a circle"))
    started.live(10, PASSIVE)
    assert [change.bus_state for _, change in started.told] == ["error-active", "error-passive"]


def test_tries_again_and_again_are_one_state(started: Started) -> None:
    backoff = AWAY._replace(state="backoff")
    for _ in range(100):
        started.live(0.5, None, None, backoff)
    assert [change.state for _, change in started.told] == ["backoff"]


def test_what_goes_by_is_not_told(started: Started) -> None:
    """An adapter whose bus flickers, and one that is plugged in again at once."""
    started.live(10, RUNNING)
    started.live(0.3, AWAY)
    started.live(10, RUNNING)
    assert len(started.told) == 1


def test_many_changes_are_few_commands_and_the_last_state_is_told(started: Started) -> None:
    for _ in range(600):
        started.live(1, RUNNING)
        started.live(1, PASSIVE)
    times = [at for at, _ in started.told]
    gaps = [after - before for before, after in itertools.pairwise(times)]
    assert gaps[0] == PAUSE_S
    assert len(times) < 30
    assert PAUSE_MAX_S <= gaps[-1] < PAUSE_MAX_S + 3
    started.live(PAUSE_MAX_S, AWAY)
    assert started.told[-1][1] == AWAY
    started.live(REST_S, AWAY)
    before = started.now
    started.live(2, RUNNING)  # after some rest it is quick again
    assert started.told[-1] == (pytest.approx(before + SETTLE_S), RUNNING)


def test_the_loop_sleeps_while_nothing_changes(started: Started) -> None:
    started.live(10, RUNNING)
    assert started._hook.next_at is None
    started.live(0.1, AWAY)
    assert started._hook.next_at == pytest.approx(10 + SETTLE_S)


@pytest.mark.parametrize(
    ("state", "bus_state", "told"),
    [
        (State.RUNNING, BusState.ERROR_PASSIVE, ("running", "error-passive")),
        (State.RUNNING, None, ("running", "")),
        (State.WAITING, BusState.ERROR_PASSIVE, ("waiting", "")),
        (State.OPENING, None, None),
        (State.STOPPED, None, None),
    ],
)
def test_what_a_bridge_is_in(state: State, bus_state: BusState | None, told: tuple[str, str] | None) -> None:
    config = SimpleNamespace(name="pc", bus=SimpleNamespace(channel="vcan0"))
    bridge: Any = SimpleNamespace(
        condition=lambda: (state, "why", True), bus_state=lambda: bus_state, config=config
    )
    change = StateHook.change_of(bridge)
    assert change == (Change(*told, "why", "pc", "vcan0") if told else None)


# --- with real processes ----------------------------------------------------------------------


def run(hook: StateHook, *command: str, change: Change = AWAY) -> int:
    """Starts it; the number of the process."""
    hook.look(command, change, 0.0)
    hook.look(command, change, SETTLE_S)
    assert hook._pid is not None
    return hook._pid


def wait_for(pid: int) -> None:
    """Until the process has ended; it is still there as a zombie."""
    os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)


def exists(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def test_what_the_command_is_told(tmp_path: Path) -> None:
    hook = StateHook()
    out = tmp_path / "out"
    script = 'env | grep ^CAN_BRIDGE_ | sort > "$1"; cat >> "$1"'
    pid = run(hook, "sh", "-c", script, "sh", str(out), change=AWAY._replace(reason="a\nb\x1b"))
    wait_for(pid)
    hook.look(("sh",), AWAY, 2.0)
    assert out.read_text().splitlines() == [
        "CAN_BRIDGE_BUS_STATE=",
        "CAN_BRIDGE_INTERFACE=vcan0",
        "CAN_BRIDGE_NAME=pc",
        r"CAN_BRIDGE_REASON=a\nb\x1b",
        "CAN_BRIDGE_STATE=waiting",
    ]
    assert not exists(pid)  # no zombie
    assert hook.next_at is None


def test_it_has_no_descriptor_of_a_bridge(tmp_path: Path) -> None:
    """A port that a command holds open could not be unplugged."""
    terminal, line = os.openpty()
    relay = _relay.Relay(
        "can232", queue=1, window=1, deadline=1, stuck=1, answer_timeout=1, sync=b"V\r", sync_prefix=b"V"
    )
    port = open_port(os.ttyname(line), 57600)
    mine = {str(Path(f"/proc/self/fd/{fd}").readlink()) for fd in (port.fd, relay.fileno())}
    hook = StateHook()
    out = tmp_path / "out"
    wait_for(run(hook, "sh", "-c", f"ls -l /proc/self/fd > {out}"))
    hook.close()
    assert not any(target in out.read_text() for target in mine)
    port.close()
    os.close(line)
    os.close(terminal)


def test_signals_are_as_a_command_expects_them(tmp_path: Path) -> None:
    """Python ignores SIGPIPE; what is ignored stays so in a child."""
    hook = StateHook()
    out = tmp_path / "out"
    wait_for(run(hook, "sh", "-c", f"grep -E 'Sig(Ign|Blk)' /proc/self/status > {out}"))
    hook.close()
    for line in out.read_text().splitlines():
        masked = int(line.split()[1], 16)
        assert not any(masked & 1 << number - 1 for number in state_hook.SIGNALS), line


def test_what_it_leaves_running_ends_with_it() -> None:
    hook = StateHook()
    reader, writer = os.pipe()
    os.set_inheritable(writer, True)
    wait_for(run(hook, "sh", "-c", "sleep 1000 & exit 0"))
    os.close(writer)
    hook.look(("sh",), AWAY, 2.0)
    assert os.read(reader, 1) == b""  # whoever had the other end is gone
    os.close(reader)


def test_one_that_does_not_end_is_killed_with_its_children(caplog: pytest.LogCaptureFixture) -> None:
    hook = StateHook()
    reader, writer = os.pipe()
    os.set_inheritable(writer, True)
    command = ("sh", "-c", "sleep 1000; true")
    pid = run(hook, *command)
    os.close(writer)
    hook.look(command, AWAY, LIMIT_S)
    assert exists(pid)
    hook.look(command, RUNNING, SETTLE_S + LIMIT_S + 1)
    wait_for(pid)
    assert os.read(reader, 1) == b""
    assert hook._pid == pid  # the next waits until it is gone
    hook.look(("true",), RUNNING, SETTLE_S + LIMIT_S + 3)
    hook.close()
    assert not exists(pid)
    assert [record.message for record in caplog.records] == [
        "notify: sh did not end within 30 s and is killed"
    ]
    os.close(reader)


def test_the_end_of_the_bridge_kills_it() -> None:
    hook = StateHook()
    reader, writer = os.pipe()
    os.set_inheritable(writer, True)
    run(hook, "sh", "-c", "trap '' TERM INT HUP; sleep 1000; true")
    os.close(writer)
    hook.close()
    assert os.read(reader, 1) == b""
    os.close(reader)
    hook.close()


@pytest.mark.parametrize(
    ("command", "failure"),
    [
        (("/nowhere/tell",), "/nowhere/tell cannot be run: No such file or directory"),
        (("sh", "-c", "exit 3"), "sh ended with status 3"),
        (("sh", "-c", "kill -9 $$"), "sh was ended by signal 9"),
    ],
)
def test_a_failure_is_told_once(
    command: tuple[str, ...], failure: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    hook = StateHook()

    def change(to: Change, now: float) -> None:
        hook.look(command, to, now)
        hook.look(command, to, now + SETTLE_S)
        if hook._pid is not None:
            wait_for(hook._pid)
        hook.look(command, to, now + 5)

    for at, to in enumerate((AWAY, RUNNING, PASSIVE)):
        change(to, 1000.0 * at)
    assert [record.message for record in caplog.records] == [f"notify: {failure}"]
    good, command = command, ("true",)
    change(AWAY, 4000.0)
    command = good
    change(RUNNING, 5000.0)
    assert len(caplog.records) == 2


def test_without_a_command_any_more(started: Started) -> None:
    """A reload has removed it: nothing is run, and nothing is told late."""
    hook = StateHook()
    hook.look((), AWAY, 0.0)
    hook.look((), AWAY, 1.0)
    assert started.told == []
    assert hook.next_at is None


def test_ignored_signals_are_named() -> None:
    assert signal.SIGPIPE in state_hook.SIGNALS
