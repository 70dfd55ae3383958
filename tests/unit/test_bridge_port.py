"""An adapter that is plugged in, and opened in the middle of that."""

import contextlib
import os
import pty
import termios
import time

import pytest
from benches.bridge import Bench, run_until, started, stopped

from bridged.bridge import port as port_module
from bridged.bridge.bridge import Bridge
from bridged.bridge.lifecycle import State
from bridged.errors import NotPermittedError, PortError
from bridged.ports import Port, open_port
from bridged.ports.watch import Watch
from bridged.simulators.can232 import Can232


@pytest.mark.parametrize("failures", [1, 5])
def test_what_was_plugged_in_is_tried_until_it_can_be_opened(bench: Bench, failures: int) -> None:
    """The news comes once, before libusb lists it or udev lets us open it; a pause is a minute here."""
    bridge, tries = plugged_in(bench, failures)
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    stopped(bridge)
    assert len(tries) == failures + 1


def test_what_stays_closed_is_not_tried_for_ever(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_module, "SETTLE_S", 0.0)
    bridge, tries = plugged_in(bench, 10)
    run_until(bridge, lambda: bridge.state is State.BACKOFF)
    timer = bridge.next_timer()
    assert timer is not None
    assert timer > time.monotonic() + 10
    stopped(bridge)
    assert len(tries) == 1


def plugged_in(bench: Bench, failures: int) -> tuple[Bridge, list[str]]:
    """A bridge that is told once of a new device, which can be opened after so many failures; the tries."""
    kernel, _ = bench.watch_events()
    bridge = bench.bridge(more="reconnect: {initial: 60, maximum: 60}")
    tries: list[str] = []

    def open_late(path: str, baudrate: int) -> Port:
        tries.append(path)
        if len(tries) <= failures:
            raise PortError("no such device")
        return open_port(path, baudrate)

    with kernel:
        started(bridge, State.WAITING)
        bench.open_port = open_late
        bench.plug_in(Can232(time.monotonic()))
        name = bench.link.resolve().name
        kernel.send(f"add@/x\0ACTION=add\0SUBSYSTEM=tty\0DEVNAME={name}\0".encode())
        run_until(bridge, lambda: len(tries) > 0)
    return bridge, tries


@pytest.mark.parametrize("patient", [True, False])
def test_permission_comes_a_moment_after_the_device(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, patient: bool
) -> None:
    """What is refused meanwhile is no error; after that time it is."""
    monkeypatch.setattr(port_module, "REFUSED_S", 1000.0 if patient else 0.0)
    monkeypatch.setattr(port_module, "SETTLE_RETRY_S", 0.0)
    tries, refusals = 0, 5

    def open_late(path: str, baudrate: int) -> Port:
        nonlocal tries
        tries += 1
        if tries <= refusals:
            raise NotPermittedError("not permitted")
        return open_port(path, baudrate)

    bench.open_port = open_late
    bench.plug_in(Can232(time.monotonic()))
    bridge = started(bench.bridge(more="reconnect: {initial: 0.01, maximum: 0.01}"))
    assert tries == refusals + 1
    assert ("not permitted" in caplog.text) is not patient
    assert ("state=backoff" in caplog.text) is not patient
    stopped(bridge)


def test_a_refusal_that_lasts_is_an_error_each_time(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """And does not hold up the end meanwhile."""
    monkeypatch.setattr(port_module, "REFUSED_S", 0.01)
    monkeypatch.setattr(port_module, "SETTLE_RETRY_S", 0.001)
    tries = 0

    def refuse(_path: str, _baudrate: int) -> Port:
        nonlocal tries
        tries += 1
        raise NotPermittedError("not permitted")

    bench.open_port = refuse
    bench.plug_in(Can232(time.monotonic()))
    bridge = started(bench.bridge(more="reconnect: {initial: 0.02, maximum: 0.02}"), State.BACKOFF)
    assert tries > 1
    assert bridge.reason == "not permitted"
    before = tries
    run_until(bridge, lambda: bridge.state is State.OPENING)
    run_until(bridge, lambda: bridge.state is State.BACKOFF)
    assert tries == before + 1
    monkeypatch.setattr(port_module, "REFUSED_S", 1000.0)
    run_until(bridge, lambda: bridge.state is State.OPENING)
    stopped(bridge)


def test_a_numbered_terminal_is_not_taken_again(bench: Bench) -> None:
    """Once the simulator has ended, the next terminal of its number is somebody's shell."""
    bench.plug_in(Can232(time.monotonic()))
    bench.link = bench.link.resolve()
    looks = 0

    class Counting(Watch):
        def is_there(self) -> bool:
            nonlocal looks
            looks += 1
            return super().is_there()

    bench.watch = Counting(str(bench.link))
    bridge = started(bench.bridge(more="reconnect: {initial: 0.01, maximum: 0.01}"))
    bench.pull_out()
    run_until(bridge, lambda: bridge.state is State.WAITING)
    assert "use a name that stays" in bridge.reason
    with contextlib.ExitStack() as stack:
        name = ""
        while name != str(bench.link):
            master, slave = pty.openpty()
            stack.callback(os.close, master)
            stack.callback(os.close, slave)
            name = os.ttyname(slave)
        before = termios.tcgetattr(slave)
        looks = 0
        run_until(bridge, lambda: looks > 3)
        assert bridge.state is State.WAITING
        assert termios.tcgetattr(slave) == before
        os.set_blocking(master, False)
        with pytest.raises(BlockingIOError):  # nothing was typed at it
            os.read(master, 1)
    stopped(bridge)
