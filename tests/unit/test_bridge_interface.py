"""The bus's end of a bridge: lost, not to be had, down, up again; and what the log says of it."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest
from benches.bridge import PairBus

from bridged.bridge import interface as interface_module
from bridged.bridge.interface import RETRY_S, Interface
from bridged.can import CAN_ERR_BUSERROR, CAN_ERR_CRTL, CAN_ERR_LOSTARB, error_frame
from bridged.config import load
from bridged.errors import InterfaceError
from bridged.interfaces import socketcan

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bridged import _relay

FRAME = error_frame(CAN_ERR_BUSERROR)
DOWN = "interface vcan0 is down: ip link set vcan0 up"


class Relay:
    """The part of a relay that Interface uses."""

    def __init__(self) -> None:
        self.bus = -1
        self.error = 0

    def attach_interface(self, fd: int) -> None:
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        self.bus = fd

    def detach_interface(self) -> None:
        self.bus = -1


class LosingBus(PairBus):
    warning = ""

    def __init__(self, warning: str = "") -> None:
        super().__init__()
        self.warning = warning

    def dropped(self) -> dict[str, int]:
        return {"socket-overflow": 3}


class Bench:
    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        file = folder / "x.yaml"
        file.write_text(
            "adapter: {type: can232, port: /dev/x}\nchannel: {bitrate: 125000}\nbus: {channel: vcan0}\n"
        )
        self.now, self.up = 1000.0, False
        self.relay = Relay()
        self.buses: list[LosingBus] = []
        self.error: InterfaceError | None = None
        self.warning = ""
        self.end = Interface(load(file), cast("_relay.Relay", self.relay), self.open)
        monkeypatch.setattr(interface_module, "time", SimpleNamespace(monotonic=lambda: self.now))
        monkeypatch.setattr(socketcan, "is_up", lambda _channel: self.up)

    def open(self, *_args: object, **_options: object) -> LosingBus:
        if self.error:
            raise self.error
        self.buses.append(LosingBus(self.warning))
        return self.buses[-1]

    def pass_time(self, seconds: float) -> None:
        end = self.now + seconds
        while (at := self.end.next_at) is not None and at <= end:
            self.now = max(self.now, at)
            self.end.on_timer(self.now)
        self.now = end


@pytest.fixture
def bench(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> Iterator[Bench]:
    caplog.set_level(logging.INFO)
    made = Bench(tmp_path, monkeypatch)
    yield made
    made.end.close()
    for bus in made.buses:
        bus.close()
        bus.far.close()


def received(bench: Bench, bus: int = 0) -> list[bytes]:
    """What others on the interface, opened for the first time or again, have got."""
    frames = []
    bench.buses[bus].far.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while frame := bench.buses[bus].far.recv(64):
            frames.append(frame)
    return frames


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    found = [record.getMessage() for record in caplog.records]
    caplog.clear()
    return found


def test_lost_and_opened_again(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    end = bench.end
    end.open()
    assert (bench.relay.bus, end.next_at) == (bench.buses[0].fd, None)
    bench.error = InterfaceError("vcan0: there is no such interface")
    end.on_lost(errno.ENODEV)
    end.on_lost(errno.ENODEV)  # late news
    bench.pass_time(100.0)
    assert (end.opened, end.reason, bench.relay.bus) == (
        None,
        "bus not open: vcan0: there is no such interface",
        -1,
    )
    assert lines(caplog) == [
        "bus open: pair",
        "bus lost: pair: No such device (was vcan0 deleted?); opening it again",
        "bus not open: vcan0: there is no such interface",
    ]
    bench.error = None
    bench.pass_time(RETRY_S)
    assert (end.opened, end.reason, end.next_at) == (bench.buses[1], "", None)
    assert end.lost_frames() == {"socket-overflow": 6}
    assert lines(caplog) == ["bus open: pair"]


@pytest.mark.parametrize("handed_over", [False, True])
def test_out_of_descriptors(bench: Bench, caplog: pytest.LogCaptureFixture, handed_over: bool) -> None:
    end = bench.end
    bench.relay.error = errno.EMFILE
    if handed_over:
        end.use(bench.open())
    else:
        end.open()
    assert (end.opened, end.reason) == (None, "bus not open: pair: Too many open files")
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(bench.buses[0].fd)
    bench.relay.error = 0
    bench.pass_time(RETRY_S)
    assert (end.opened, end.reason, end.next_at) == (bench.buses[1], "", None)
    assert lines(caplog) == ["bus not open: pair: Too many open files", "bus open: pair"]


def test_down_and_up_again(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    end = bench.end
    end.open()
    end.on_down()
    end.on_down()
    bench.pass_time(3600.0)
    assert (end.reason, end.is_up) == (DOWN, False)
    bench.up = True
    bench.pass_time(RETRY_S)
    assert end.is_up
    assert (end.reason, end.next_at, len(bench.buses)) == ("", None, 1)
    assert lines(caplog) == ["bus open: pair", DOWN, "interface vcan0 is up again"]


def test_down_from_the_start(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    bench.warning = "vcan0 is down: ip link set vcan0 up"
    bench.end.open()
    bench.end.on_down()  # the kernel says it, too
    bench.up = True
    bench.pass_time(2 * RETRY_S)
    assert lines(caplog) == ["bus open: pair", bench.warning, "interface vcan0 is up again"]


def test_deleted_while_down(bench: Bench) -> None:
    bench.end.open()
    bench.end.on_down()
    bench.end.on_lost(errno.ENODEV)
    bench.pass_time(0.0)
    assert (bench.end.opened, bench.end.reason) == (bench.buses[1], "")


def test_what_comes_and_goes_all_the_time_fills_no_log(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    bench.up = True
    bench.end.open()
    for _ in range(1000):
        bench.end.on_down()
        bench.pass_time(2.0)
        bench.end.on_lost(errno.ENODEV)
        bench.pass_time(1.0)
    assert len(lines(caplog)) < 30


def test_error_frames_are_counted(bench: Bench) -> None:
    end = bench.end
    end.put_error_frame(FRAME)  # no bus
    end.open()
    end.put_error_frame(FRAME)
    assert bench.buses[0].far.recv(64) == FRAME
    bench.buses[0].far.close()
    bench.pass_time(1.0)
    end.put_error_frame(FRAME)
    assert end.error_frames() == {"error_frames": 1, "error_frames_lost": 1, "error_frames_left_out": 0}


def test_a_flood_of_error_frames_is_limited_and_its_last_state_always_told(bench: Bench) -> None:
    """One of state and one of anything else in 10 ms."""
    end = bench.end
    end.open()
    for tec in range(10_000):
        end.put_error_frame(error_frame(CAN_ERR_CRTL, crtl=0x08, tec=tec % 250))
        end.put_error_frame(error_frame(CAN_ERR_LOSTARB if tec % 2 else CAN_ERR_BUSERROR))
        bench.pass_time(0.0001)
    bench.pass_time(1.0)
    frames = received(bench)
    assert 198 <= len(frames) <= 204
    states = [frame for frame in frames if frame[9]]
    assert states[0] == error_frame(CAN_ERR_CRTL, crtl=0x08, tec=0)
    assert states[-1] == error_frame(CAN_ERR_CRTL, crtl=0x08, tec=9_999 % 250)
    assert error_frame(CAN_ERR_LOSTARB | CAN_ERR_BUSERROR) in frames  # nothing that happened is missing
    assert end.error_frames()["error_frames_left_out"] == 20_000 - len(frames)
    assert end.next_at is None


def test_an_error_frame_that_waits_is_told_before_the_interface_is_closed(bench: Bench) -> None:
    bench.end.open()
    for tec in (1, 2, 3):
        bench.end.put_error_frame(error_frame(CAN_ERR_CRTL, crtl=0x08, tec=tec))
    bench.end.hand_over()
    assert [frame[14] for frame in received(bench)] == [1, 3]


def test_error_frames_go_on_on_an_interface_that_was_lost_while_one_waited(bench: Bench) -> None:
    bench.end.open()
    for tec in (1, 2):
        bench.end.put_error_frame(error_frame(CAN_ERR_CRTL, crtl=0x08, tec=tec))
    bench.end.on_lost(errno.ENODEV)
    bench.pass_time(1.0)
    for tec in (3, 4):
        bench.end.put_error_frame(error_frame(CAN_ERR_CRTL, crtl=0x08, tec=tec))
    bench.pass_time(1.0)
    assert [frame[14] for frame in received(bench)] == [1, 2]
    assert [frame[14] for frame in received(bench, 1)] == [3, 4]
    assert bench.end.next_at is None


def test_handed_over(bench: Bench) -> None:
    bench.end.open()
    bus: Any = bench.end.hand_over()
    assert (bus, bench.end.opened, bench.relay.bus) == (bench.buses[0], None, -1)
    assert bench.end.hand_over() is None
    bench.end.use(bus)
    assert bench.relay.bus == bus.fd
    bench.end.on_down()
    assert bench.end.hand_over() is bus


def test_handed_over_while_down(bench: Bench) -> None:
    """Frames of before may still wait in it; and that it is up again must be noticed."""
    bench.end.open()
    bench.end.on_down()
    bus: Any = bench.end.hand_over()
    bench.end.use(bus, bench.end.reason)
    bench.pass_time(2 * RETRY_S)
    assert bench.end.reason == DOWN
    bench.up = True
    bench.pass_time(RETRY_S)
    assert (bench.end.reason, bench.end.next_at) == ("", None)


def test_is_up() -> None:
    interfaces = Path("/sys/class/net")
    names = os.listdir(interfaces) if interfaces.exists() else []  # noqa: PTH208 - names are wanted
    for name in names:
        if (interfaces / name / "flags").exists():
            flags = int((interfaces / name / "flags").read_text(), 16)
            assert socketcan.is_up(name) == bool(flags & 1)
    assert not socketcan.is_up("no-such-one")
