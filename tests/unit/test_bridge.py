"""Bridge, relay and adapter against a simulated CAN232 on a real pty; only the CAN side is a socketpair."""

import errno
import logging
import os
import re
import select
import socket
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from benches.bridge import FRAME, Bench, PairPort, run_until, started, stopped
from benches.simulating import until

from bridged import _relay
from bridged.bridge.lifecycle import Action, Event, State, Verdict
from bridged.daemon.service import serve
from bridged.ports.watch import Watch
from bridged.simulators.can232 import Can232
from bridged.simulators.can232 import State as Channel
from bridged.simulators.serve import Fault


def type_in(device: Can232, *commands: bytes) -> None:
    """What a program before us did."""
    for command in commands:
        device.host_writes(time.monotonic(), command)
        device.advance(time.monotonic())
    device.take_output(time.monotonic())


def test_what_an_action_leads_to_waits_until_the_actions_before_it_are_done(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bridge = bench.bridge()
    actions: list[Action] = []

    def perform(action: Action) -> Verdict | None:
        actions.append(action)
        return Verdict(Event.TIMER) if action is Action.RELEASE else None

    monkeypatch.setattr(bridge, "_perform", perform)
    bridge._life.state = State.CLOSING
    bridge._act_on(Verdict(Event.CLOSED))
    assert actions == [Action.RELEASE, Action.WAIT, Action.OPEN]
    assert bridge.state is State.OPENING
    bridge.close()


def test_an_interface_that_was_lost_with_the_port_is_opened_again(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its event comes with those of the port that is given back, which mean nothing any more."""
    bridge = bench.bridge()
    bridge._interface.open()
    relay = SimpleNamespace(events=lambda: [(_relay.EVENT_INTERFACE_LOST, errno.ENODEV, b"")])
    monkeypatch.setattr(bridge._loop, "relay", relay)
    bridge._release()
    assert bridge._interface.opened is None
    assert bridge._interface.reason.startswith("bus lost: pair")
    bridge.close()


def test_frames_both_ways_and_closed_at_the_end(bench: Bench) -> None:
    bench.plug_in(Can232(time.monotonic()))
    bridge = started(bench.bridge())
    frames = [FRAME.pack(0x100 + n, n % 9, bytes(range(n % 9))) for n in range(50)]
    for frame in frames:
        bench.bus.far.send(frame)
    run_until(bridge, lambda: bridge.snapshot()["counters"]["tx_frames"] == 50)
    status = stopped(bridge)
    assert [f.can_id for f in bench.frames] == [0x100 + n for n in range(50)]
    assert bench.device.state is not Channel.OPEN
    assert status["adapter"] | {"port": ""} == {
        "type": "can232",
        "port": "",
        "opened": None,
        "version": "V1324",
        "serial_number": "A123",
        "firmware": "can232",
        "sent_means": bridge.adapter.sent_means,
    }


def test_a_hundred_starts_write_the_eeprom_once(bench: Bench) -> None:
    bench.plug_in(Can232(time.monotonic()))
    for _ in range(100):
        stopped(started(bench.bridge("bitrate: 125000, acceptance: {code: 0x6000, mask: 0x1FF0}")))
        until(lambda: bench.device.state is not Channel.OPEN)  # on a busy machine it may be late
    assert bench.device.eeprom.writes == 1
    assert bench.frames == []


def test_filter_mode_is_written_once_and_remembered(bench: Bench) -> None:
    bench.plug_in(Can232(time.monotonic()))
    config = "bitrate: 125000, acceptance: {code: 0x6000, mask: 0x1FF0, mode: single}"
    for _ in range(3):
        stopped(started(bench.bridge(config)))
    assert (bench.device.eeprom.writes, bench.device.eeprom.single_filter) == (2, 1)


def test_time_stamps_are_switched_off_at_the_start_after_they_were_seen(bench: Bench) -> None:
    device = Can232(time.monotonic())
    device.eeprom.auto_poll = device.eeprom.time_stamps = True
    bench.plug_in(device, traffic_fps=100)
    bridge = started(bench.bridge())
    run_until(bridge, lambda: bridge.snapshot()["counters"]["rx_stamped"] > 3)
    stopped(bridge)
    assert device.eeprom.time_stamps == 1
    stopped(started(bench.bridge()))
    stopped(started(bench.bridge()))
    assert (device.eeprom.time_stamps, device.eeprom.writes) == (0, 1)


@pytest.mark.parametrize("left_over", [b"t1232AAB", b"t1232AABB", b"T1234567", b"r", b"S", b"Q", b"X"])
def test_a_half_typed_command_of_another_program_does_nothing(bench: Bench, left_over: bytes) -> None:
    device = Can232(time.monotonic())
    type_in(device, b"S4\r", b"O\r", left_over)
    assert device.state is Channel.OPEN
    bench.plug_in(device)
    stopped(started(bench.bridge()))
    assert bench.frames == []
    assert device.eeprom.writes == 1


def test_a_device_that_starts_open_and_talking(bench: Bench) -> None:
    device = Can232(time.monotonic())
    type_in(device, b"S4\r", b"X1\r", b"O\r", b"Q1\r")
    device.power_cycle(time.monotonic())
    assert device.state is Channel.OPEN
    bench.plug_in(device, traffic_fps=500)
    bridge = started(bench.bridge())
    bench.bus.far.recv(16)
    status = stopped(bridge)
    assert status["counters"]["rx_errors"] <= 1  # at most the line we came into the middle of


def test_firmware_without_auto_poll_is_polled(bench: Bench) -> None:
    device = Can232(time.monotonic(), version="V1011")
    bench.plug_in(device, traffic_fps=200)
    bridge = started(bench.bridge())
    for _ in range(20):
        bench.bus.far.recv(16)
    bench.bus.far.send(FRAME.pack(0x7FF, 0, b""))
    run_until(bridge, lambda: bench.frames)
    stopped(bridge)
    assert device.eeprom.writes == 0


@pytest.mark.parametrize("after", range(1, 16))
def test_stop_in_the_middle_of_initialisation_leaves_it_closed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    bench.plug_in(Can232(time.monotonic()))
    bridge = bench.bridge()
    asked = 0
    ask = bridge._exchanges.ask

    def counting(*args: Any) -> None:
        nonlocal asked
        asked += 1
        ask(*args)

    monkeypatch.setattr(bridge._exchanges, "ask", counting)
    bridge.start()
    run_until(bridge, lambda: asked >= after or bridge.state is State.RUNNING)
    stopped(bridge)
    assert bench.device.state is not Channel.OPEN


def test_another_serial_number_is_a_fault(bench: Bench) -> None:
    bench.plug_in(Can232(time.monotonic(), serial_number="B007"))
    bridge = started(bench.bridge(serial_number="A123"), State.FAULT)
    assert "B007" in bridge.reason
    assert "A123" in bridge.reason
    stopped(bridge)


def test_silence_is_told_then_ends(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    device = Can232(time.monotonic())
    device.silent = True
    bench.plug_in(device)
    bridge = bench.bridge()
    bridge.start()
    run_until(bridge, lambda: bridge.state is State.CLOSING)
    assert "no answer to V" in bridge.reason
    device.silent = False
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    device.silent = True
    bench.bus.far.send(FRAME.pack(1, 0, b""))
    run_until(bridge, lambda: bridge.state is State.CLOSING)
    assert "stopped answering" in bridge.reason
    device.silent = False
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    assert "no answer from the adapter: resynchronising" in caplog.text
    assert re.search("state=closing: the adapter stopped answering; trying again in [0-9.]+ s", caplog.text)
    stopped(bridge)


def test_pulled_out_and_plugged_in_again(bench: Bench) -> None:
    bench.plug_in(Can232(time.monotonic()))
    bridge = started(bench.bridge())
    run_until(bridge, lambda: bridge.snapshot()["bus_state"] == "error-active")
    bench.pull_out()
    run_until(bridge, lambda: bridge.state is State.BACKOFF)
    assert "lost" in bridge.reason
    assert bridge.snapshot()["bus_state"] is None  # nobody tells any more
    bench.bus.far.send(FRAME.pack(1, 0, b""))
    run_until(bridge, lambda: bridge.snapshot()["counters"]["tx_dropped"]["adapter-away"] == 1)
    bench.plug_in(Can232(time.monotonic()))
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    stopped(bridge)
    assert bench.frames == []


def test_plugged_in_late_and_told_at_once(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    """By its link and by the kernel's event, which are one cause; the pause alone would last a minute."""
    kernel, ours = bench.watch_events()
    bridge = bench.bridge(more="reconnect: {initial: 60, maximum: 60}")
    with kernel, caplog.at_level(logging.INFO):
        started(bridge, State.WAITING)
        assert bridge.snapshot()["reason"].startswith(f"{bench.link}: does not exist; serial adapters here:")
        kernel.send(b"add@/x\0ACTION=add\0SUBSYSTEM=tty\0DEVNAME=ttyUSB77\0")  # another one
        run_until(bridge, lambda: not select.select([ours], (), (), 0)[0])
        assert bridge.state is State.WAITING
        bench.plug_in(Can232(time.monotonic()))
        name = bench.link.resolve().name
        kernel.send(f"add@/x\0ACTION=add\0SUBSYSTEM=tty\0DEVNAME={name}\0".encode())
        run_until(bridge, lambda: bridge.state is State.RUNNING)
        stopped(bridge)
    lines = [
        record.getMessage().partition(":")[0]
        for record in caplog.records
        if record.name == "bridged.bridge.lifecycle"
    ]
    assert [line for line in lines if "state=" in line] == [
        "state=opening",
        "state=waiting",
        "state=running",
        "state=stopping",
        "state=stopped",
    ]


def test_what_has_no_events_is_found_by_looking(bench: Bench) -> None:
    class Deaf(Watch):
        def arm(self) -> None:
            pass

    bench.watch = Deaf(str(bench.link))
    bridge = bench.bridge(more="reconnect: {initial: 0.01, maximum: 0.05}")
    started(bridge, State.WAITING)
    bench.plug_in(Can232(time.monotonic()))
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    bench.pull_out()
    run_until(bridge, lambda: bridge.state is State.WAITING)
    stopped(bridge)


def test_the_same_failure_is_told_once(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    device = Can232(time.monotonic())
    device.silent = True
    bench.plug_in(device)
    caplog.set_level(logging.DEBUG)
    bridge = bench.bridge(more="reconnect: {initial: 0.01, maximum: 0.02}")
    bridge.start()

    def levels() -> list[int]:
        return [record.levelno for record in caplog.records if "no answer to V" in record.getMessage()]

    run_until(bridge, lambda: len(levels()) == 3)
    stopped(bridge)
    assert levels() == [logging.WARNING, logging.DEBUG, logging.DEBUG]


def test_refused_frames_are_explained_and_sent_again(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    device = Can232(time.monotonic())
    bench.plug_in(device)
    bridge = started(bench.bridge())
    device.refusals = 5
    with caplog.at_level(logging.WARNING):
        for n in range(3):
            bench.bus.far.send(FRAME.pack(n, 0, b""))
        run_until(bridge, lambda: bridge.snapshot()["counters"]["tx_frames"] == 3)
        run_until(bridge, lambda: "its status" in caplog.text)
    status = stopped(bridge)
    assert status["counters"]["tx_retries"] == 5
    assert [f.can_id for f in bench.frames] == [0, 1, 2]


def test_listen_only_opens_so_and_sends_nothing(bench: Bench) -> None:
    bench.plug_in(Can232(time.monotonic()))
    bridge = started(bench.bridge("bitrate: 125000, listen_only: true"))
    assert bench.device.state is Channel.LISTEN_ONLY
    bench.bus.far.send(FRAME.pack(1, 0, b""))
    run_until(bridge, lambda: bridge.snapshot()["counters"]["tx_dropped"]["listen-only"] == 1)
    stopped(bridge)
    assert bench.frames == []


def test_a_bug_in_the_bridge_still_ends_it_and_closes_the_channel(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.plug_in(Can232(time.monotonic()))
    bridge = bench.bridge()

    def bug() -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(bridge.adapter, "health_questions", bug)
    with pytest.raises(ZeroDivisionError):
        serve(bridge, None)
    while bench.device.state is not Channel.CLOSED:
        os.sched_yield()


def test_an_adapter_that_was_reset_is_initialised_again(bench: Bench) -> None:
    bench.plug_in(Can232(time.monotonic()), faults=(Fault("reset", 0.5),))
    bridge = started(bench.bridge())
    run_until(bridge, lambda: bridge.state is State.CLOSING)
    assert "channel is closed" in bridge.reason
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    stopped(bridge)


def test_noise_is_named_where_it_may_be_the_cause(bench: Bench) -> None:
    device = Can232(time.monotonic())
    device.silent = True
    bench.plug_in(device, faults=(Fault("garbage", 0, 60),))
    bridge = bench.bridge()
    bridge.start()
    run_until(bridge, lambda: bridge.state is State.CLOSING)
    assert "; there is noise on the line" in bridge.reason
    stopped(bridge)


def lines(port: PairPort) -> Iterator[bytes]:
    while True:
        for line in port.far.recv(4096).replace(b"\r", b"\r\n").split(b"\n"):
            if line.strip():
                yield line


def test_each_piece_of_the_flush_is_a_write_of_its_own(bench: Bench) -> None:
    """So it becomes a USB packet of its own; also with a window that lets several commands go at once."""
    port = PairPort(socket.SOCK_SEQPACKET)
    bench.open_port = lambda *_args: port
    bridge = bench.bridge(transmit="{window: 8}")
    bridge.start()
    writes: list[bytes] = []
    while len(writes) < 5:
        run_until(bridge, lambda: select.select([port.far], (), (), 0)[0])
        writes.append(port.far.recv(4096))
    assert writes == [b"V" * 50] * 4 + [b"V\r"]
    port.far.close()
    stopped(bridge)


@pytest.mark.parametrize(("last", "state"), [(b"S4\r", State.FAULT), (b"O\r", State.BACKOFF)])
def test_the_plug_is_pulled_in_the_moment_that_ends_a_state(bench: Bench, last: bytes, state: State) -> None:
    port = PairPort()
    bench.open_port = lambda *_args: port

    def device() -> None:
        closing = 0
        for line in lines(port):
            closing += closing > 0
            if line == last and state is State.FAULT:
                port.far.send(b"\a")
                break
            if line == last:
                closing = 1  # no answer: it gives up, and closes
            elif line in {b"v\r", b"F\r"} and closing == 0:
                port.far.send(b"\a")
            elif closing < 3:
                port.far.send(b"V1324\r" if b"V" in line else b"NA123\r" if b"N" in line else b"\r")
            else:
                port.far.send(b"\r")
                break
        port.far.close()

    thread = threading.Thread(target=device)
    thread.start()
    bridge = bench.bridge()
    bridge.start()

    def ended() -> bool:
        if bridge.state in {State.INITIALISING, State.CLOSING}:
            time.sleep(0.01)  # a Python that is a little slow: events gather
        return bridge.state is state

    run_until(bridge, ended)
    thread.join()
    stopped(bridge)


def test_a_port_that_the_relay_cannot_take_is_closed_and_tried_again(bench: Bench) -> None:
    """As where no descriptor is left; here it is a file, for which epoll does not wait."""
    file = (bench.folder / "file").open("w")
    port = SimpleNamespace(fd=file.fileno(), failure=None, serial_number=None, close=file.close)
    bench.open_port = lambda *_args: port
    bridge = bench.bridge()
    bridge.start()
    run_until(bridge, lambda: bridge.state in {State.BACKOFF, State.WAITING})
    assert bridge.reason == f"{bench.link}: cannot be used: Operation not permitted"
    assert file.closed
    stopped(bridge)


def test_a_bug_at_the_start_does_not_leave_the_process_behind(bench: Bench) -> None:
    def bug(*_args: object, **_options: object) -> None:
        raise ZeroDivisionError

    bench.open_interface = bug
    bridge = bench.bridge()
    with pytest.raises(ZeroDivisionError):
        serve(bridge, None)
    assert "relay" not in {thread.name for thread in threading.enumerate()}
