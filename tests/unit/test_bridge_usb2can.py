"""Bridge, relay and adapter against a simulated USB2CAN on a real pty; only the CAN side is a socketpair."""

import contextlib
import itertools
import logging
import random
import select
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from benches.bridge import LIMIT_S, STOP_GRACE_S, PairPort, Usb2canBench, run_until, started, stopped

from bridged.bridge.bridge import Bridge
from bridged.bridge.lifecycle import State
from bridged.simulators.ends import unpack
from bridged.simulators.serve import mixed_frames
from bridged.simulators.sja1000 import Frame
from bridged.simulators.usb2can import State as Mode
from bridged.simulators.usb2can import Usb2can

SLOW = "bitrate: 10000"  # a frame takes 5 ms and more


@pytest.fixture
def bench(usb2can_bench: Usb2canBench) -> Usb2canBench:
    return usb2can_bench


def numbered(count: int, length: int = 0) -> list[Frame]:
    return [Frame(n, False, False, length, bytes(length)) for n in range(count)]


def mixed(seed: int, count: int) -> list[Frame]:
    return list(itertools.islice(mixed_frames(random.Random(seed)), count))


def counters(bridge: Bridge) -> dict[str, Any]:
    return bridge.snapshot()["counters"]  # type: ignore[no-any-return]


def sent(bridge: Bridge, count: int) -> Callable[[], bool]:
    """Whether the adapter has taken so many."""
    return lambda: counters(bridge)["tx_frames"] >= count


def assert_closed(bench: Usb2canBench, device: Usb2can) -> None:
    """And nothing was ever wrong. Afterwards the device is no more."""
    bench.pull_out()
    assert device.state is Mode.CONFIG
    assert device.chip.in_reset
    assert device.violations == []


# --- frames -----------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["HW0003FW0016", "HW0003FW5016"])
def test_frames_both_ways_are_exact_and_it_is_closed_at_the_end(bench: Usb2canBench, version: str) -> None:
    device = bench.device_plugged_in(version=version)
    bridge = started(bench.bridge(transmit="{deadline: 20}"))
    to_device, to_us = mixed(1, 300), mixed(2, 300)
    bench.send(*to_device)
    bench.bus.far.setblocking(False)
    received: list[Frame | None] = []
    pieces = iter([to_us[at : at + 20] for at in range(0, len(to_us), 20)])

    def all_here() -> bool:
        bench.send_from_its_bus(*next(pieces, []))
        with contextlib.suppress(BlockingIOError):
            while True:
                received.append(unpack(bench.bus.far.recv(16)))
        return len(received) >= len(to_us) and counters(bridge)["tx_frames"] >= len(to_device)

    run_until(bridge, all_here)
    status = stopped(bridge)
    assert_closed(bench, device)
    assert received == to_us
    assert bench.frames == to_device
    assert status["counters"]["skipped_bytes"] == 2 * len(b"\xff\xff")  # the answer to CONFIG_MODE
    assert status["counters"]["resyncs"] == 0
    assert status["adapter"] | {"port": ""} == {
        "type": "usb2can",
        "port": "",
        "opened": None,
        "version": version,
        "serial_number": None,
        "firmware": None,
        "sent_means": "sent means taken by the adapter, by what it answers about the level of its buffer",
    }


@pytest.mark.parametrize(
    "options", [{"answers_get": False}, {"get_length_4": True}, {"processing_s": 0.0002}]
)
def test_frames_are_exact_whatever_the_firmware_tells(bench: Usb2canBench, options: dict[str, Any]) -> None:
    device = bench.device_plugged_in(**options)
    bridge = started(bench.bridge(transmit="{deadline: 20}"))
    frames = mixed(2, 200)
    bench.send(*frames)
    run_until(bridge, lambda: len(bench.frames) >= len(frames))
    stopped(bridge)
    assert_closed(bench, device)
    assert bench.frames == frames


def test_listen_only_sends_nothing(bench: Usb2canBench) -> None:
    device = bench.device_plugged_in()
    bridge = started(bench.bridge("bitrate: 500000, listen_only: true"))
    assert device.chip.listen_only
    bench.send(*numbered(3))
    bench.send_from_its_bus(*numbered(50))
    run_until(bridge, lambda: counters(bridge)["tx_dropped"]["listen-only"] == 3)
    run_until(bridge, lambda: counters(bridge)["rx_frames"] == 50)
    stopped(bridge)
    bench.pull_out()
    assert (bench.frames, device.counters.frames_taken) == ([], 0)
    assert device.state is Mode.CONFIG


def test_frames_that_it_has_taken_are_on_the_bus_before_it_is_closed(bench: Usb2canBench) -> None:
    device = bench.device_plugged_in()
    bridge = started(bench.bridge(SLOW))
    frames = numbered(15, length=8)
    bench.send(*frames)
    run_until(bridge, sent(bridge, 10))
    taken = stopped(bridge)["counters"]["tx_frames"]
    assert_closed(bench, device)
    assert device.counters.frames_discarded == 0
    assert bench.frames == frames[:taken]


# --- starts and stops -------------------------------------------------------------------------


def test_thirty_starts_and_stops(bench: Usb2canBench) -> None:
    device = bench.device_plugged_in()
    for n in range(30):
        bridge = started(bench.bridge())
        bench.send(*numbered(n))
        run_until(bridge, sent(bridge, n))
        stopped(bridge)
        assert device.state is Mode.CONFIG
        assert device.chip.in_reset
    assert_closed(bench, device)
    assert len(bench.frames) == sum(range(30))


def count_calls(owner: object, name: str, monkeypatch: pytest.MonkeyPatch) -> list[None]:
    calls: list[None] = []
    method = getattr(owner, name)

    def counted(*args: Any) -> None:
        calls.append(None)
        method(*args)

    monkeypatch.setattr(owner, name, counted)
    return calls


def reached(bridge: Bridge, calls: list[None], count: int) -> Callable[[], bool]:
    return lambda: len(calls) >= count or bridge.state is State.RUNNING


@pytest.mark.parametrize("answered", [False, True], ids=["asked", "answered"])
def test_stop_at_each_step_of_initialisation_leaves_it_closed(
    bench: Usb2canBench, monkeypatch: pytest.MonkeyPatch, answered: bool
) -> None:
    """As a signal would: when the step has been asked for, or once its answer lies there."""
    device = bench.device_plugged_in()
    ran = False
    for after in itertools.count(1):
        bridge = bench.bridge()
        asked = count_calls(bridge._exchanges, "ask", monkeypatch)
        bridge.start()
        run_until(bridge, reached(bridge, asked, after))
        ran = bridge.state is State.RUNNING
        if answered and not ran:
            assert select.select([bridge.filenos()[0]], [], [], LIMIT_S)[0]
        stopped(bridge)
        assert device.state is Mode.CONFIG
        assert device.chip.in_reset
        if ran:
            break
    assert after > 20
    assert_closed(bench, device)


def test_stop_amid_traffic_both_ways(bench: Usb2canBench) -> None:
    device = bench.device_plugged_in(traffic_fps=2000)
    bridge = started(bench.bridge("bitrate: 125000"))
    frames = mixed(3, 200)
    bench.send(*frames)
    run_until(bridge, sent(bridge, 20))
    taken = stopped(bridge)["counters"]["tx_frames"]
    assert_closed(bench, device)
    assert bench.frames[:taken] == frames[:taken]
    assert device.counters.frames_discarded == 0


def test_abort_closes_it_too(bench: Usb2canBench) -> None:
    device = bench.device_plugged_in()
    bridge = started(bench.bridge())
    bridge.abort()
    bridge.close()
    end = time.monotonic() + LIMIT_S
    while not device.chip.in_reset:
        assert time.monotonic() < end
        time.sleep(0)
    assert_closed(bench, device)


# --- what goes wrong --------------------------------------------------------------------------


def test_a_reset_behind_our_back_is_noticed_and_mended(bench: Usb2canBench) -> None:
    device = bench.device_plugged_in()
    bridge = started(bench.bridge())
    numbers = itertools.count()

    def reset_once(device: Usb2can) -> None:
        if len(bench.frames) == 20:
            device.power_cycle(time.monotonic())

    bench.on_frame = reset_once

    def sending(state: State) -> Callable[[], bool]:
        def look() -> bool:
            bench.send(*(Frame(n, True, False, 0, b"") for n in itertools.islice(numbers, 5)))
            return bridge.state is state

        return look

    run_until(bridge, lambda: sending(State.RUNNING)() and len(bench.frames) >= 20)
    run_until(bridge, sending(State.CLOSING))
    assert bridge.reason == "the adapter is in mode BOOT: it was reset, or another program uses it"
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    before = len(bench.frames)
    run_until(bridge, lambda: sending(State.RUNNING)() and len(bench.frames) > before + 20)
    stopped(bridge)
    assert_closed(bench, device)
    ids = [frame.can_id for frame in bench.frames]
    assert sorted(set(ids)) == ids  # none twice, none out of order
    assert device.counters.commands["CONFIG_MODE"] >= 3  # a start, an end, a start at least


def test_silence_ends_and_it_is_initialised_again(bench: Usb2canBench) -> None:
    device = bench.device_plugged_in()
    bridge = started(bench.bridge())
    bench.send(*numbered(1))
    run_until(bridge, sent(bridge, 1))
    device.silent = True
    bench.send(*numbered(1))
    run_until(bridge, lambda: bridge.state is State.CLOSING)
    assert bridge.reason == "the adapter stopped answering"
    device.silent = False
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    bench.send(*numbered(3))
    run_until(bridge, sent(bridge, 4))
    status = stopped(bridge)
    assert status["counters"]["tx_dropped"]["unanswered"] == 1
    assert_closed(bench, device)


def test_a_silent_device_is_told_and_tried_again(bench: Usb2canBench) -> None:
    device = bench.device_plugged_in()
    device.silent = True
    bridge = bench.bridge()
    bridge.start()
    run_until(bridge, lambda: bridge.state is State.CLOSING)
    assert "no answer to CONFIG_MODE and GET_MODE" in bridge.reason
    device.silent = False
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    stopped(bridge)
    assert_closed(bench, device)


def test_pulled_out_and_plugged_in_again(bench: Usb2canBench) -> None:
    bench.device_plugged_in()
    bridge = started(bench.bridge())
    bench.pull_out()
    run_until(bridge, lambda: bridge.state is State.BACKOFF)
    bench.send(*numbered(2))
    run_until(bridge, lambda: counters(bridge)["tx_dropped"]["adapter-away"] == 2)
    device = bench.device_plugged_in(junk=b"\xff\x0f\x41")
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    stopped(bridge)
    assert_closed(bench, device)
    assert bench.frames == []


def test_fms_firmware_is_a_fault(bench: Usb2canBench) -> None:
    device = bench.device_plugged_in(version="HW0003FW7016")
    bridge = started(bench.bridge(), State.FAULT)
    assert "FMS firmware (HW0003FW7016)" in bridge.reason
    stopped(bridge)
    assert_closed(bench, device)


def test_a_serial_number_that_cannot_be_kept_to_is_a_fault(bench: Usb2canBench) -> None:
    device = bench.device_plugged_in()
    bridge = started(bench.bridge(serial_number="A6008isP"), State.FAULT)
    assert "adapter.serial_number wants A6008isP" in bridge.reason
    stopped(bridge)
    assert_closed(bench, device)


def test_a_triple_is_a_fault(bench: Usb2canBench) -> None:
    port = PairPort()
    bench.open_port = lambda *_args: port

    def triple() -> None:
        while port.far.recv(4096):
            port.far.send(bytes.fromhex("0F21054142431F0FEF"))
        port.far.close()

    thread = threading.Thread(target=triple)
    thread.start()
    bridge = started(bench.bridge(), State.FAULT)
    assert "is a CANLAB Triple" in bridge.reason
    stopped(bridge)
    thread.join(LIMIT_S)


# --- a device that stops reading --------------------------------------------------------------


class StallingDevice:
    """A simulated USB2CAN at the far end of a socketpair; it reads `reads` bytes more (None: all)."""

    def __init__(self, bench: Usb2canBench) -> None:
        self.port = PairPort()
        self.openings = 0
        self.reads: int | None = None
        self.device = Usb2can(time.monotonic(), stop_grace_s=STOP_GRACE_S)
        self.frames: list[Frame] = []
        self._thread = threading.Thread(target=self._live)
        self._thread.start()
        bench.open_port = self._open

    def _open(self, *_args: object) -> PairPort:
        self.openings += 1
        return self.port

    def _live(self) -> None:
        far, device = self.port.far, self.device
        while True:
            if select.select([far] if self.reads != 0 else [], [], [], 0.001)[0]:
                data = far.recv(4096 if self.reads is None else self.reads)
                if not data:
                    return
                if self.reads is not None:
                    self.reads -= len(data)
                device.host_writes(time.monotonic(), data)
            if output := device.take_output(time.monotonic()):
                far.send(output)
            self.frames += device.take_bus_frames()

    def stop(self) -> None:
        self.reads = None
        self._thread.join(LIMIT_S)
        assert not self._thread.is_alive()
        self.port.far.close()


@pytest.fixture
def stalling(bench: Usb2canBench) -> Iterator[tuple[Bridge, StallingDevice]]:
    """In the middle of one of three frames, when it is noticed."""
    end = StallingDevice(bench)
    bridge = started(bench.bridge())
    end.reads = 20
    bench.send(*numbered(3, length=8))
    run_until(bridge, lambda: bridge.state is State.CLOSING)
    assert end.reads == 0
    yield bridge, end
    if not bridge.finished:
        stopped(bridge)
    end.stop()


def test_a_frame_is_whole_though_the_device_stopped_reading_in_it(
    stalling: tuple[Bridge, StallingDevice], caplog: pytest.LogCaptureFixture
) -> None:
    bridge, end = stalling
    run_until(bridge, lambda: bridge.state is State.BACKOFF)
    end.reads = None
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    assert (end.openings, counters(bridge)["reconnects"]) == (1, 1)
    assert counters(bridge)["tx_dropped"]["unanswered"] > 0
    assert "the adapter reads no more: its port stays open" in caplog.text
    assert [frame for frame in end.frames if frame not in numbered(3, length=8)] == []
    assert end.device.violations == []


def test_a_device_that_reads_on_at_the_end_or_later_is_closed(
    stalling: tuple[Bridge, StallingDevice], bench: Usb2canBench
) -> None:
    """Also by the next bridge in the same process, after a reload."""
    bridge, end = stalling
    successor = bench.bridge()
    bridge.stop(successor.config)
    run_until(bridge, lambda: bridge.settled)
    end.reads = None
    deadline = time.monotonic() + LIMIT_S
    while not end.device.chip.in_reset:
        assert time.monotonic() < deadline
        time.sleep(0)
    assert [frame for frame in end.frames if frame not in numbered(3, length=8)] == []
    successor.start(bridge)
    run_until(successor, lambda: successor.state is State.RUNNING)
    assert end.openings == 1
    stopped(successor)
    assert end.device.violations == []


# --- flow, events, counters -------------------------------------------------------------------


def test_stops_are_obeyed_and_counted(bench: Usb2canBench) -> None:
    device = bench.device_plugged_in()
    bridge = started(bench.bridge(SLOW, transmit="{deadline: 20}", critical_limit=2, ready_limit=1))
    frames = numbered(40)
    bench.send(*frames)
    run_until(bridge, lambda: len(bench.frames) == 40)
    status = stopped(bridge)
    assert_closed(bench, device)
    assert bench.frames == frames
    assert status["counters"]["tx_stops"] == device.counters.stops > 0
    assert status["counters"]["tx_returned"] == 0


def test_frames_handed_back_go_again_in_order_and_are_counted(
    bench: Usb2canBench, caplog: pytest.LogCaptureFixture
) -> None:
    device = bench.device_plugged_in()
    bridge = started(bench.bridge(transmit="{window: 1, deadline: 20}"))
    device.refusals = 5
    bench.send(*numbered(20))
    with caplog.at_level(logging.WARNING):
        run_until(bridge, sent(bridge, 20))
        run_until(bridge, lambda: "adapter refuses frames; its status: bus good" in caplog.text)
    status = stopped(bridge)
    assert_closed(bench, device)
    assert bench.frames == numbered(20)
    assert status["counters"]["tx_returned"] == status["counters"]["tx_retries"] == 5


def test_events_are_told_or_counted(bench: Usb2canBench, caplog: pytest.LogCaptureFixture) -> None:
    device = bench.device_plugged_in()
    bridge = started(bench.bridge())

    def trouble(device: Usb2can) -> None:
        now = time.monotonic()
        for _ in range(3):
            device.overrun(now)
        device.value_2_burst(now, 5)
        device.set_error_counters(now, 96, 0)
        device.set_bus_off(now, True)
        device.set_bus_off(now, False)
        bench.on_frame = lambda _device: None

    bench.on_frame = trouble
    bench.send(*numbered(1))
    run_until(bridge, lambda: counters(bridge)["rx_overruns"] == 3)
    run_until(bridge, lambda: "adapter reports: bus-off, it restarts by itself" in caplog.text)
    assert "adapter reports: error counters crossed the warning limit (TEC=96 REC=0" in caplog.text
    bench.send(*numbered(20))
    run_until(bridge, sent(bridge, 21))
    status = stopped(bridge)
    assert_closed(bench, device)
    assert status["counters"]["rx_overruns"] == device.counters.overruns == 3
    assert status["counters"]["tx_stops"] == device.counters.stops


def test_no_frame_is_lost_between_the_controllers_start_and_ours(bench: Usb2canBench) -> None:
    """The bus is busy: frames come from the moment that register MOD lets the controller take part."""
    device = bench.device_plugged_in(traffic_fps=5000)
    bridge = started(bench.bridge())
    run_until(bridge, lambda: bridge.snapshot()["counters"]["rx_frames"] > 100)
    status = stopped(bridge)
    assert status["counters"]["rx_dropped"]["not-running"] == 0
    assert device.counters.frames_unseen > 0  # there were some before
