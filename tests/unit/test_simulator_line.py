"""The simulator in real time: as a USB2CAN, with counted frames, with a record, on a line that is there."""

import errno
import itertools
import json
import os
import random
import signal
import socket
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
from benches.simulating import TIMEOUT_S, ask, by_hand, count_calls, host, process, read, running, until

from bridged import cli
from bridged.errors import BusError, PortError
from bridged.simulators.can232 import Can232, Eeprom
from bridged.simulators.ends import LineEnd, open_can
from bridged.simulators.faults import CAN232_FAULTS, MEANINGS, USB2CAN_FAULTS
from bridged.simulators.serve import CYCLIC, Simulator, cyclic_frames, mixed_frames, record_line
from bridged.simulators.sja1000 import Frame
from bridged.simulators.usb2can import State, Usb2can

VERSION_ANSWER = b"\x0f\x21\x0cHW0001FW1002"
PASS_ALL = b"".join(b"\x0f\x12\x02" + bytes((16 + n, 0 if n < 4 else 0xFF)) for n in range(8))
START = (
    b"\x0f\x02\x00"  # CONFIG_MODE
    b"\x0f\x12\x02\x00\x01\x0f\x12\x02\x1f\xc0" + PASS_ALL + b"\x0f\x12\x02\x08\xda\x0f\x12\x02\x04\x03"
    b"\x0f\x12\x02\x06\x00\x0f\x12\x02\x07\x14"  # 1 Mbit/s
    b"\x0f\x20\x02\x00\x0f\x0f\x20\x02\x01\x07"  # limits
    b"\x0f\x03\x00\x0f\x12\x02\x00\x00"  # NORMAL_MODE, MOD
)
START_ANSWER = b"\xff\xff" + b"".join(
    b"\x0f\x12\x01" + bytes((register,)) for register in (0, 31, *range(16, 24), 8, 4, 6, 7, 0)
)


def usb2can_message(frame: Frame) -> bytes:
    """What a USB2CAN makes of a frame on its bus."""
    device = Usb2can()
    device.host_writes(0.0, START)
    device.take_output(0.0)
    device.bus_frame(0.0, frame)
    return device.take_output(0.0)


def test_the_command_simulates_a_usb2can(tmp_path: Path):
    record, state = tmp_path / "record", tmp_path / "state"
    options = (
        "--record",
        str(record),
        "--mixed",
        "--traffic",
        "5000",
        "--count",
        "200",
        "--seed",
        "5",
        "--version",
        "HW0001FW1002",
    )
    frames = [frame for frame, _ in zip(mixed_frames(random.Random(5)), range(200), strict=False)]
    with process(tmp_path, "usb2can", *options) as child:
        with host(tmp_path / "tty") as fd:
            ask(fd, START, START_ANSWER + b"".join(map(usb2can_message, frames)))
            ask(fd, b"\x0f\x21\x00", VERSION_ANSWER)
            os.write(fd, b"\x0f\x40\x05\x02\x20\x00\x11\x33")
            until(lambda: record.read_text() == "100#1133\n")
        child.send_signal(signal.SIGTERM)
        assert child.wait(TIMEOUT_S) == 0
    seen = json.loads(state.read_text())
    assert seen["state"] == "normal"
    assert seen["counters"]["frames_sent"] == 1
    assert seen["violations"] == []
    assert (seen["port"][:5], seen["host_lost"], seen["bus"]) == ("/dev/", 0, None)
    assert seen["traffic"] == {"count": 200, "made_up": 200}
    assert "uart" not in seen


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


# The made-up bus and the record


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


def test_options_that_make_no_sense(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for options, text in (
        (["--count", "5"], "--traffic"),
        (["--record", f"{tmp_path}/no/file"], "no directory"),
        (["--record", f"{tmp_path}"], "cannot be written"),
        (["--line", f"{tmp_path}/line"], "No such file"),
    ):
        assert cli.main(["simulate", "usb2can", *options]) == 1
        assert text in capsys.readouterr().err
    for options in (["can232", "--fault", "lostgo@1"], ["usb2can", "--link", "a", "--line", "b"]):
        with pytest.raises(SystemExit):
            cli.main(["simulate", *options])


def test_arguments_that_are_no_numbers(capsys: pytest.CaptureFixture[str]):
    for arguments, text in (
        (["demo", "--duration", "abc"], "argument --duration: expected a number above 0, got 'abc'"),
        (["demo", "--rate", "-1"], "argument --rate: expected a number above 0, got '-1'"),
        (["simulate", "can232", "--count", "1.5"], "--count: expected a whole number above 0, got '1.5'"),
        (["simulate", "can232", "--count", "0"], "--count: expected a whole number above 0, got '0'"),
    ):
        with pytest.raises(SystemExit):
            cli.main(arguments)
        assert text in capsys.readouterr().err


def test_every_fault_is_explained(capsys: pytest.CaptureFixture[str]):
    for adapter, kinds in (("can232", CAN232_FAULTS), ("usb2can", USB2CAN_FAULTS)):
        with pytest.raises(SystemExit):
            cli.main(["simulate", adapter, "--help"])
        shown = "".join(capsys.readouterr().out.split())
        for kind in kinds:
            assert f"{kind}: {MEANINGS[kind]}".replace(" ", "") in shown


@pytest.mark.parametrize(
    ("at", "code", "text"),
    [
        ("__init__", errno.EAFNOSUPPORT, r"has no SocketCAN: try `modprobe can_raw`"),
        (
            "bind",
            errno.ENODEV,
            "vcan7: there is no such interface: `ip link add dev vcan7 type vcan; ip link set",
        ),
        ("bind", errno.EPERM, "vcan7: cannot be opened as a CAN interface: Operation not permitted"),
    ],
)
def test_a_bus_that_cannot_be_had(monkeypatch: pytest.MonkeyPatch, at: str, code: int, text: str):
    class Refusing:
        def __init__(self, *_: object) -> None:
            self.bind = self.close = lambda *_: None
            if at == "__init__":
                raise OSError(code, os.strerror(code))
            self.bind = self.refuse

        def refuse(self, _: object) -> None:
            raise OSError(code, os.strerror(code))

    monkeypatch.setattr(socket, "socket", Refusing)
    with pytest.raises(BusError, match=text):
        open_can("vcan7")


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


# A line that is there


def test_a_terminal_that_is_there_is_the_line(tmp_path: Path):
    path = tmp_path / "line"
    masters = []
    for _ in range(2):
        master, slave = os.openpty()
        tty.setraw(slave)
        masters.append((master, slave, os.ttyname(slave)))
    (master, slave, name), (other_master, other_slave, other_name) = masters
    path.symlink_to(name)
    simulator = Simulator(Can232(time.monotonic()), line=str(path))
    os.close(slave)
    turns, looks = count_calls(simulator, "_turn"), count_calls(simulator._host, "reconnect")
    with running(simulator):
        ask(master, b"S4\r", b"\r")
        os.close(master)
        until(lambda: len(looks) > 3)
        assert len(turns) < 100  # neither spins nor crashes
        new_master, new_slave = os.openpty()
        assert os.ttyname(new_slave) != name  # so nobody else's terminal is taken for the line
        path.unlink()
        path.symlink_to(other_name)
        ask(other_master, b"O\r", b"\r")  # what has come before we look is not lost
    for fd in (other_master, other_slave, new_master, new_slave):
        os.close(fd)


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as ours:
        ours.bind(f"{tmp_path}/socket")
        ours.settimeout(TIMEOUT_S)
        yield ours


def test_a_socket_is_connected_to_as_often_as_it_has_to(listener: socket.socket):
    simulator, clock = by_hand(None, "unplug@1+1", line=f"unix:{listener.getsockname()}")
    looks = count_calls(simulator._host, "reconnect")
    with running(simulator):
        until(lambda: looks)  # nobody has listened yet
        listener.listen()
        clock.set(0.5)
        with listener.accept()[0] as first:
            ask(first.fileno(), b"S4\r", b"\r")
        with listener.accept()[0] as second:
            ask(second.fileno(), b"O\r", b"\r")  # the device kept its bit rate
            clock.set(1)
            assert read(second.fileno(), 1) == b""  # unplugged
        clock.set(2)
        with listener.accept()[0] as third:
            ask(third.fileno(), b"O\rV\r", b"\aV1324\r")  # it had no power


def test_no_line_is_an_error(tmp_path: Path):
    (tmp_path / "file").touch()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(f"{tmp_path}/socket")
        for line in ("nothing", "file", "socket"):
            with pytest.raises(PortError, match=line):
                Simulator(Can232(), line=f"{tmp_path}/{line}")
    with pytest.raises(PortError, match="too long"):
        LineEnd(f"unix:/{'long' * 50}").open()
