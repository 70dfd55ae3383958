"""The simulator in real time: a real pseudo terminal, a socket as its bus, made-up traffic, its files."""

import argparse
import contextlib
import itertools
import json
import os
import random
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from benches.simulating import (
    START,
    START_ANSWER,
    TIMEOUT_S,
    ask,
    by_hand,
    host,
    process,
    read,
    running,
    until,
)

from bridged.errors import InterfaceError, PortError
from bridged.simulators.can232 import Can232
from bridged.simulators.can232_memory import Eeprom, load_eeprom
from bridged.simulators.ends import HOST_BUFFER, BusEnd, HeldUp, PtyEnd, open_can, pack, unpack
from bridged.simulators.faults import Fault, parse_fault
from bridged.simulators.serve import CYCLIC, Simulator, cyclic_frames, mixed_frames, record_line
from bridged.simulators.sja1000 import Frame
from bridged.simulators.uart import Uart
from bridged.simulators.usb2can import State, Usb2can

FRAME = Frame(0x100, False, False, 2, b"\x11\x33")


@pytest.fixture
def bus() -> Iterator[tuple[socket.socket, socket.socket]]:
    """The simulator's end and ours."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(TIMEOUT_S)
    with ours, theirs:
        yield theirs, ours


def test_frames_are_what_the_kernel_calls_a_can_frame():
    frames = [Frame(0x1ABCDE23, True, False, 2, b"\x11\x33"), Frame(0x7FF, False, True, 3, b"")]
    assert pack(frames[0]).hex() == "23debc9a" + "02000000" + "1133000000000000"
    assert [unpack(pack(frame)) for frame in frames] == frames
    error = pack(Frame(0x20000004, False, False, 8, bytes(8)))
    assert unpack(error) is None
    assert unpack(b"") is None


def test_both_ways_over_a_terminal_and_a_bus(bus: tuple[socket.socket, socket.socket], tmp_path: Path):
    link = tmp_path / "can232"
    theirs, ours = bus
    simulator = Simulator(Can232(time.monotonic()), link=link, bus=theirs)
    rng = random.Random(7)
    frames = [frame for frame, _ in zip(mixed_frames(rng), range(300), strict=False)]
    with running(simulator):
        until(link.is_symlink)
        with host(link) as fd:
            ask(fd, b"X1\rS8\r", b"\r\r")
        with host(link) as fd:  # a host may come and go
            ask(fd, b"O\rV\r", b"\rV1324\r")
            for frame in frames:
                ours.send(pack(frame))
                line = read(fd, 1)
                while not line.endswith(b"\r"):
                    line += read(fd, 1)
                os.write(fd, line)
                assert read(fd, 2) in {b"z\r", b"Z\r"}
                assert unpack(ours.recv(16)) == frame
    assert not link.is_symlink()
    assert simulator.device.counters.frames_sent == len(frames)
    assert simulator.device.counters.refused == 0


def test_a_paced_line_takes_its_time():
    device = Can232(time.monotonic(), uart=Uart(9600))
    with running(Simulator(device, precise=True)) as simulator, host(simulator.port) as fd:
        begun = time.monotonic()
        for _ in range(10):
            ask(fd, b"V\r", b"V1324\r")
        elapsed_s = time.monotonic() - begun
    assert elapsed_s >= 10 * (2 + 6) * 10 / 9600 - 10 * device.uart.late_max_s
    assert device.uart.device_busy_s == pytest.approx(60 * 10 / 9600)


def test_a_host_that_does_not_read_loses_its_own_and_blocks_nothing():
    simulator = Simulator(Can232(time.monotonic(), eeprom=Eeprom(auto_poll=True)), traffic_fps=50_000)
    with running(simulator), host(simulator.port) as fd:
        ask(fd, b"S8\rO\r", b"\r\r")
        until(lambda: simulator.state()["host_lost"])
        os.write(fd, b"C\r")
        until(lambda: simulator.device.counters.commands["C"])


def test_what_a_host_does_not_read_is_kept_up_to_a_bound():
    end = PtyEnd()
    with host(end.name) as fd:
        for _ in range(1000):
            end.write(b"t1000\r" * 100)
        assert len(end.waiting) == HOST_BUFFER
        taken = 600_000 - HOST_BUFFER - end.lost
        assert read(fd, taken)[:12] == b"t1000\rt1000\r"
        end.write(b"")
        assert len(end.waiting) < HOST_BUFFER
    end.close()


def test_made_up_traffic_comes_at_its_rate_and_frames_sent_are_shown():
    sent: list[Frame] = []
    device = Can232(time.monotonic(), eeprom=Eeprom(auto_poll=True))
    simulator = Simulator(device, traffic_fps=1000, on_frame=sent.append)
    with running(simulator), host(simulator.port) as fd:
        ask(fd, b"S8\rO\r", b"\r\r")
        begun = time.monotonic()
        lines = b""
        while lines.count(b"\r") < 300:
            lines += os.read(fd, 4096)
        assert time.monotonic() - begun >= 0.29
        os.write(fd, b"t10021133\r")
        until(lambda: sent)
    assert sent == [FRAME]
    assert {chr(line[0]) for line in lines.split(b"\r") if line} == set("tTrR")


def test_unplugging_hangs_up_and_plugging_in_makes_a_new_port(tmp_path: Path):
    link = tmp_path / "can232"
    simulator, clock = by_hand(None, "unplug@1+1", link=link)
    with running(simulator), host(simulator.port) as fd:
        ask(fd, b"S4\r", b"\r")
        assert link.is_symlink()
        clock.set(1)
        until(lambda: not link.is_symlink())
        with contextlib.suppress(OSError):  # EIO: the line is dead
            assert os.read(fd, 1) == b""
        clock.set(2)
        until(link.is_symlink)
        with host(link) as again:
            ask(again, b"O\r", b"\a")  # it lost its power too


def test_faults_come_and_go():
    simulator, clock = by_hand(
        None, "silence@1+1", "busoff@1+1", "refuse@3+1", "drop@5", "garbage@6+1", "reset@8", "poweroff@9+1"
    )
    device = simulator.device
    with running(simulator), host(simulator.port) as fd:
        ask(fd, b"S8\rO\r", b"\r\r")
        clock.set(1.5)
        until(lambda: device.silent and device.bus_off)
        clock.set(2.5)
        until(lambda: not device.silent and not device.bus_off)
        clock.set(3.5)
        until(lambda: device.refusals)
        ask(fd, b"t1000\rt1000\rV\r", b"\a\aV1324\r")
        clock.set(4.5)
        until(lambda: not device.refusals)
        clock.set(5.5)
        until(lambda: device.drop_answers)
        ask(fd, b"t1000\rV\r", b"V1324\r")
        clock.set(6.5)
        assert read(fd, 1)  # of garbage: nothing was asked
        clock.set(7.5)
        clock.set(8.5)
        until(lambda: not device.bitrate)
        clock.set(9.5)
        until(lambda: not device.powered)
        clock.set(10.5)
        until(lambda: device.powered)


def test_fault_specifications():
    assert parse_fault("silence@5+3") == Fault("silence", 5, 3)
    assert parse_fault("reset@1.5") == Fault("reset", 1.5)
    for text in ("silence", "silence@", "fire@1", "silence@1+", "silence@-1"):
        with pytest.raises(argparse.ArgumentTypeError, match=r"KIND@START"):
            parse_fault(text)


def test_the_kernels_time_of_arrival_is_used():
    """On a socket that has it (here UDP), a frame that waited for us says how long."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as theirs:
        theirs.bind(("127.0.0.1", 0))
        end = BusEnd(theirs)

        def waited() -> bool:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
                ours.sendto(pack(FRAME), theirs.getsockname())
            begun = time.monotonic()
            until(lambda: time.monotonic() - begun > 0.02)
            ((age_s, frame),) = end.read()
            assert frame == FRAME
            return 0.02 <= age_s < TIMEOUT_S

        until(waited)  # the kernel begins to stamp a while after it was told to


def test_time_without_a_processor_is_not_the_hosts():
    simulator, clock = by_hand()
    held_up = iter([1.0, 1.5, 1.8, 1.8])  # seconds in all, at each look
    simulator._held_up = lambda: next(held_up)
    clock.set(9.0)
    with host(simulator.port) as fd:
        os.write(fd, b"V\r")
        *_, seen = simulator._wait(clock.now, None)  # slept, then waited half a second for a processor
        assert seen == pytest.approx(8.5)
        *_, seen = simulator._wait(clock.now, 0)  # did not sleep: 0.3 s since the last look
        assert seen == pytest.approx(8.7)
        *_, seen = simulator._wait(clock.now, 0)
        assert seen == pytest.approx(9.0)
    simulator.stop()
    simulator.run()
    own = HeldUp()
    assert 0 <= own() <= own()


def test_a_late_delivery_is_known_to_be_late():
    device = Can232(uart=Uart(9600))
    simulator, clock = by_hand(device)
    with running(simulator), host(simulator.port) as fd:
        os.write(fd, b"V\r")
        until(lambda: device.uart.host_backlog)
        clock.set(1)
        assert read(fd, 6) == b"V1324\r"
    assert device.uart.late_s == pytest.approx(1 - 8 * 10 / 9600)


def test_a_frame_is_stamped_when_it_came_not_when_it_was_read(
    bus: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
):
    def read_late(end: BusEnd) -> list[tuple[float, Frame]]:
        end.socket.recv(16)
        return [(0.5, FRAME)]

    monkeypatch.setattr(BusEnd, "read", read_late)
    device = Can232(eeprom=Eeprom(auto_poll=True, time_stamps=True))
    simulator, clock = by_hand(device, bus=bus[0])
    with running(simulator), host(simulator.port) as fd:
        ask(fd, b"S8\rO\r", b"\r\r")
        clock.now = 2.0
        bus[1].send(pack(FRAME))
        assert read(fd, 14) == b"t1002113305DC\r"  # 1500 ms


def test_a_bus_that_does_not_take_frames_loses_them_counted(bus: tuple[socket.socket, socket.socket]):
    end = BusEnd(bus[0])
    end.write([FRAME] * 20_000)
    taken = 0
    bus[1].setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while bus[1].recv(16):
            taken += 1
    assert taken + len(end.waiting) + end.lost == 20_000
    bus[1].close()
    assert list(end.read()) == []
    assert end.gone


def test_a_missing_can_interface_is_an_error():
    with pytest.raises(InterfaceError, match="CAN"):
        open_can("nocan99")


def test_a_link_does_not_replace_a_file(tmp_path: Path):
    link = tmp_path / "file"
    link.write_text("precious")
    simulator = Simulator(Can232(), link=link)
    with pytest.raises(PortError, match="choose another"):
        simulator.run()
    assert link.read_text() == "precious"


def test_a_broken_eeprom_file_is_an_error(tmp_path: Path):
    file = tmp_path / "eeprom"
    assert load_eeprom(file) == Eeprom()
    for text in ("", "[]", '{"colour": 1}'):
        file.write_text(text)
        with pytest.raises(PortError, match="not an EEPROM file"):
            load_eeprom(file)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_command_keeps_its_eeprom_and_ends_with_0(tmp_path: Path, number: signal.Signals):
    link, state = tmp_path / "tty", tmp_path / "state"
    options = ("--eeprom", f"{tmp_path}/eeprom", "--version", "V1335", "--serial-number", "B00F")
    for start in (1, 2):
        with process(tmp_path, "can232", *options, "--fault", "silence@900+1") as child:
            with host(link) as fd:
                ask(fd, b"V\rN\rX1\rS4\rO\rt1000\r", b"V1335\rNB00F\r\r\r\rz\r")
            assert not state.exists()
            child.send_signal(signal.SIGUSR1)
            until(state.exists)
            seen = json.loads(state.read_text())
            assert seen["eeprom"]["writes"] == start
            assert seen["counters"]["commands"]["t"] == 1
            assert seen["channel"] == "open"
            assert seen["uart"]["rate"] is None
            child.send_signal(number)
            assert child.wait(TIMEOUT_S) == 0
        assert not link.is_symlink()
        state.unlink()
    assert json.loads((tmp_path / "eeprom").read_text())["writes"] == 2


def test_a_host_that_does_not_read_holds_a_usb2can_back():
    device = Usb2can(time.monotonic())
    simulator = Simulator(device, traffic_fps=50_000)
    with running(simulator), host(simulator.port) as fd:
        ask(fd, START, START_ANSWER)
        until(lambda: device.counters.overruns)
        os.write(fd, b"\x0f\x40\x05\x02\x20\x00\x11\x33")
        until(lambda: device.counters.frames_sent)
        assert simulator.state()["host_lost"] == 0


def test_the_faults_of_a_usb2can():
    device = Usb2can()
    simulator, clock = by_hand(device, "value2@1", "lostgo@2+1", "lostgo@4", "overrun@6")
    with running(simulator), host(simulator.port) as fd:
        ask(fd, START, START_ANSWER)
        clock.set(1)
        assert read(fd, 100) == b"\x0f\x09\x02\x02\x02" * 20
        clock.set(2)
        until(lambda: device.lose_go > 1)
        clock.set(3)
        until(lambda: not device.lose_go)
        clock.set(4)
        until(lambda: device.lose_go == 1)
        clock.set(6)
        assert read(fd, 4) == b"\x0f\x09\x01\x03"
    assert device.state is State.NORMAL


def test_counted_frames_are_not_spent_on_a_channel_that_is_not_open():
    twin = Can232(eeprom=Eeprom(auto_poll=True))
    twin.host_writes(0.0, b"S8\rO\r")
    twin.take_output(0.0)
    lines = []
    for frame, _ in zip(mixed_frames(random.Random(0)), range(60), strict=False):
        twin.bus_frame(0.0, frame)
        lines.append(twin.take_output(0.0))
    device = Can232(eeprom=Eeprom(auto_poll=True))
    counters = device.counters
    simulator, clock = by_hand(device, traffic_fps=1000, traffic_count=60)
    with running(simulator), host(simulator.port) as fd:
        clock.set(0.0205)
        until(lambda: counters.frames_unseen == 20)
        ask(fd, b"S8\rO\r", b"\r\r")
        clock.set(0.0505)
        ask(fd, b"", b"".join(lines[:30]))
        ask(fd, b"C\r", b"\r")
        clock.set(0.0805)
        until(lambda: counters.frames_unseen == 50)
        ask(fd, b"O\r", b"\r")
        clock.set(0.1205)
        ask(fd, b"", b"".join(lines[30:]))
        clock.set(0.1605)
        ask(fd, b"V\r", b"V1324\r")
    assert simulator.state()["traffic"] == {"count": 60, "made_up": 60}


def test_a_bus_that_was_late_does_not_catch_up():
    simulator, clock = by_hand(traffic_fps=1000)
    with running(simulator):
        clock.set(100.0005)
        until(lambda: simulator.device.counters.frames_unseen > 40)
        clock.set(100.0015)
    assert 50 <= simulator.device.counters.frames_unseen <= 52


def test_cyclic_traffic():
    """Ten identifiers whose first bytes count, each at its own rate; the same with the same seed."""
    frames = list(itertools.islice(cyclic_frames(random.Random(3)), 6400))
    assert frames == list(itertools.islice(cyclic_frames(random.Random(3)), 6400))
    per_unit = sum(1 / period for _, _, period in CYCLIC)
    for can_id, dlc, period in CYCLIC:
        own = [frame for frame in frames if frame.can_id == can_id]
        assert abs(len(own) - 6400 / period / per_unit) <= 1
        assert {(len(frame.data), frame.dlc, frame.remote) for frame in own} == {(dlc, dlc, False)}
        assert [frame.data[:2] for frame in own] == [
            (count % 256 ** min(dlc, 2)).to_bytes(min(dlc, 2), "little") for count in range(len(own))
        ]
        assert len({frame.data[2:] for frame in own}) == 1


def test_what_is_recorded_is_what_cansend_takes():
    lines = {
        Frame(0x123, False, False, 2, b"\x11\x22"): "123#1122\n",
        Frame(0x123, True, False, 1, b"\xab"): "00000123#AB\n",
        Frame(0x12345678, True, False, 0, b""): "12345678#\n",
        Frame(0x123, False, True, 5, b""): "123#R5\n",
        Frame(0x7, False, True, 0, b""): "007#R\n",
    }
    assert [record_line(frame) for frame in lines] == list(lines.values())
