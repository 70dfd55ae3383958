"""A bridge takes the place of another on the same bus, as at a reload that reopens the adapter."""

import contextlib
import itertools
import socket
import time
from collections.abc import Callable

import pytest
from benches.bridge import FRAME, Bench, PairBus, Usb2canBench, run_until, started, stopped
from books import check_books

from bridged.bridge.bridge import Bridge
from bridged.bridge.lifecycle import State
from bridged.interfaces.socketcan import receive_stamped
from bridged.simulators.can232 import Can232

INTERVAL_S = 0.01


@pytest.fixture
def bench(bench: Bench) -> Bench:
    receive_stamped(bench.bus._near)
    bench.plug_in(Can232(time.monotonic()))
    return bench


class Traffic:
    """A frame each INTERVAL_S, numbered by its identifier; later on a busy machine, and never two at once."""

    def __init__(self, far: socket.socket) -> None:
        self._far = far
        self._due_at = self._began = time.monotonic()
        self.sent = 0

    def __call__(self) -> int:
        """Sends one if it is due and there is room for it; how many it has sent."""
        now = time.monotonic()
        if now >= self._due_at:
            with contextlib.suppress(BlockingIOError):  # this thread runs the bridge, too
                self._far.send(FRAME.pack(self.sent, 0, b""), socket.MSG_DONTWAIT)
                self.sent += 1
            self._due_at = now + INTERVAL_S
        return self.sent


def handed_over(bench: Bench, old: Bridge, transmit: str = "{window: 2}") -> Bridge:
    """Another bridge; the old one has ended."""
    new = bench.bridge(transmit=transmit)
    old.stop(new.config)
    run_until(old, lambda: old.settled)
    return new


def after(seconds: float) -> Callable[[], bool]:
    end = time.monotonic() + seconds
    return lambda: time.monotonic() >= end


@pytest.fixture
def usb2can(usb2can_bench: Usb2canBench) -> Usb2canBench:
    usb2can_bench.device_plugged_in()
    return usb2can_bench


@pytest.mark.parametrize("adapter", ["can232", "usb2can"])
def test_no_frame_is_lost_under_traffic_and_the_counters_go_on(
    adapter: str, request: pytest.FixtureRequest
) -> None:
    bench: Bench = request.getfixturevalue("bench" if adapter == "can232" else adapter)
    bridges = [bench.bridge(transmit="{deadline: 60}")]
    receive_stamped(bench.bus._near)
    traffic = Traffic(bench.bus.far)
    started(bridges[0])
    run_until(bridges[0], lambda: traffic() and bridges[0].state is State.RUNNING)
    for window in itertools.islice(itertools.cycle((2, 1)), 3):
        old = bridges[-1]
        run_until(old, lambda goal=traffic.sent + 30: traffic() >= goal)  # type: ignore[misc]
        new = bench.bridge(transmit=f"{{deadline: 60, window: {window}}}")
        old.stop(new.config)
        run_until(old, lambda bridge=old: traffic() and bridge.settled)  # type: ignore[misc]
        new.start(old)
        status = new.snapshot()
        check_books(status["counters"], status["queued"])
        run_until(new, lambda bridge=new: traffic() and bridge.state is State.RUNNING)  # type: ignore[misc]
        bridges.append(new)
    new = bridges[-1]
    run_until(new, lambda: new.snapshot()["counters"]["tx_frames"] == traffic.sent)
    status = stopped(new)
    counters = status["counters"]
    assert [frame.can_id for frame in bench.frames] == list(range(traffic.sent))
    assert counters["reconnects"] == 0
    assert counters["bus_read"] == traffic.sent
    assert sum(counters["tx_dropped"].values()) == 0
    assert status["uptime_s"] >= (traffic.sent - 1) * INTERVAL_S


def test_what_was_read_before_is_sent_first(bench: Bench) -> None:
    old = started(bench.bridge(transmit="{deadline: 5.0}"))
    for number in range(40):
        bench.bus.far.send(FRAME.pack(number, 0, b""))
    run_until(old, lambda: old.snapshot()["queued"] > 1)
    new = handed_over(bench, old, "{deadline: 5.0, window: 2}")
    new.start(old)
    run_until(new, lambda: len(bench.frames) == 40)
    assert [frame.can_id for frame in bench.frames] == list(range(40))
    assert sum(stopped(new)["counters"]["tx_dropped"].values()) == 0


def test_a_frame_that_has_waited_too_long_is_dropped(bench: Bench) -> None:
    old = started(bench.bridge(transmit="{deadline: 0.2}"))
    new = handed_over(bench, old, "{deadline: 0.2, window: 2}")
    bench.bus.far.send(FRAME.pack(1, 0, b""))
    run_until(old, after(0.25))
    new.start(old)
    run_until(new, lambda: new.state is State.RUNNING)
    bench.bus.far.send(FRAME.pack(2, 0, b""))
    run_until(new, lambda: bench.frames)
    assert [frame.can_id for frame in bench.frames] == [2]
    assert stopped(new)["counters"]["tx_dropped"]["stale"] == 1


def test_an_adapter_that_fails_to_start_leaves_no_frame_behind(bench: Bench) -> None:
    old = started(bench.bridge())
    new = handed_over(bench, old)
    bench.pull_out()
    bench.bus.far.send(FRAME.pack(1, 0, b""))
    new.start(old)
    run_until(new, lambda: new.snapshot()["counters"]["tx_dropped"]["adapter-away"] == 1)
    stopped(new)


def test_a_stop_meanwhile_counts_the_frames_that_wait(bench: Bench) -> None:
    old = started(bench.bridge())
    new = bench.bridge(transmit="{window: 2}")
    old.stop(new.config)
    for _ in range(3):
        bench.bus.far.send(FRAME.pack(1, 0, b""))
    new.close()
    assert stopped(old)["counters"]["tx_dropped"]["stopped"] == 3


def test_a_stop_does_not_wait_for_frames_that_were_to_be_sent_before_a_reload(bench: Bench) -> None:
    old = started(bench.bridge("bitrate: 10000", "{deadline: 60}"))
    for _ in range(100):
        bench.bus.far.send(FRAME.pack(1, 8, b""))
    run_until(old, lambda: old.snapshot()["queued"] > 50)
    new = bench.bridge(transmit="{window: 2}")
    old.stop(new.config)
    assert old.state is State.RUNNING
    new.close()
    old.stop()
    assert old.state is State.STOPPING
    assert stopped(old)["counters"]["tx_dropped"]["stopped"] > 0


def test_frames_of_the_adapter_go_on_while_its_channel_is_closed(bench: Bench) -> None:
    """Only what comes from the bus waits."""
    bench.pull_out()
    bench.plug_in(Can232(time.monotonic()), traffic_fps=500)
    old = started(bench.bridge())
    new = handed_over(bench, old)
    assert old.snapshot()["counters"]["rx_dropped"]["bus-lost"] == 0
    new.start(old)
    stopped(new)


def test_an_interface_that_is_lost_while_it_is_handed_over_is_opened_again(bench: Bench) -> None:
    new = handed_over(bench, old := started(bench.bridge()))
    bench.bus.far.close()
    lost, bench.bus = bench.bus, PairBus()
    new.start(old)
    run_until(new, lambda: new.state is State.RUNNING and new.snapshot()["bus"]["up"])
    bench.bus.far.send(FRAME.pack(1, 0, b""))
    run_until(new, lambda: bench.frames)
    stopped(new)
    lost.close()
