"""Bus-off and what looks like it: `channel.restart`, and what waits in the adapter's buffer meanwhile."""

import contextlib
import itertools
import logging
import time
from types import SimpleNamespace
from typing import Any, cast

import can
import pytest
from benches.bridge import FRAME, Bench, Usb2canBench, run_until, started, stopped
from benches.simulating import until

from bridged.adapters.base import Sending, Steps
from bridged.bridge import lifecycle
from bridged.bridge.bridge import Bridge
from bridged.bridge.lifecycle import Event, State, Verdict
from bridged.bridge.recovery import Recovery
from bridged.can import CAN_ERR_BUSOFF, CAN_ERR_CRTL, CAN_ERR_RESTARTED, CRTL_ACTIVE, BusState, error_frame
from bridged.interfaces.python_can import PythonCanInterface
from bridged.settings import After, Restart
from bridged.simulators.can232 import Can232

OLD, NEW = 0x100, 0x1FFFFFFF
EFF_FLAG = 0x80000000
DEADLINE_S = 0.5
TRANSMIT = f"{{deadline: {DEADLINE_S}}}"


@pytest.fixture
def can232(bench: Bench) -> Bench:
    return bench


@pytest.fixture
def usb2can(usb2can_bench: Usb2canBench) -> Usb2canBench:
    return usb2can_bench


def send(bench: Bench, can_id: int, count: int = 1) -> None:
    for n in range(count):
        bench.bus.far.send(FRAME.pack(EFF_FLAG | can_id, 1, bytes([n])))


def frames_on_bus(bench: Bench) -> list[bytes]:
    """What a program on the bus has got."""
    frames = []
    bench.bus.far.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while frame := bench.bus.far.recv(16):
            frames.append(frame)
    return frames


def heals(bench: Bench, bridge: Bridge, device: Can232, born: list[float]) -> None:
    """The bus is good again; of what was sent while it was not, nothing comes that is too old."""
    run_until(bridge, lambda: bridge.state not in {State.RUNNING, State.CLOSING})
    oldest = time.monotonic() - DEADLINE_S
    device.set_bus_off(time.monotonic(), False)
    run_until(bridge, lambda: bridge.state is State.RUNNING)

    def arrived() -> bool:
        """A frame may be lost on the way, where the machine is busy: then the next one is sent."""
        if not bridge.snapshot()["queued"]:
            send(bench, NEW)
        return any(frame.can_id == NEW for frame in bench.frames)

    run_until(bridge, arrived)
    status = stopped(bridge)
    assert bench.frames[-1].can_id == NEW
    assert all(born[frame.can_id - OLD] > oldest for frame in bench.frames if frame.can_id != NEW)
    told = frames_on_bus(bench)
    assert told.index(error_frame(CAN_ERR_BUSOFF)) < told.index(error_frame(CAN_ERR_RESTARTED))
    # On a busy machine the device may also be too late with an answer, which is another reason.
    assert 1 <= status["counters"]["bus_off_restarts"] <= status["counters"]["reconnects"]


def test_an_interface_without_error_frames_makes_no_counter_negative(can232: Bench) -> None:
    """The bridge's own error frames are no frames of the adapter's, wherever they end."""
    bus = PythonCanInterface("pcan", "x", can.Bus(interface="virtual", channel=str(can232.folder)))
    can232.open_interface = lambda *_args, **_options: bus
    device = Can232(time.monotonic())
    can232.plug_in(device)
    bridge = started(can232.bridge())
    device.set_bus_off(time.monotonic(), True)
    run_until(bridge, lambda: bridge.snapshot()["counters"]["error_frames_lost"])
    counters = stopped(bridge)["counters"]
    assert (counters["error_frames"], counters["rx_frames"]) == (0, 0)
    assert sum(counters["rx_dropped"].values()) == 0


def test_a_can232_that_refuses_everything_is_restarted(can232: Bench) -> None:
    device = Can232(time.monotonic())
    can232.plug_in(device)
    bridge = started(can232.bridge(transmit=TRANSMIT, more="health: {interval: 0.5}"))
    device.set_bus_off(time.monotonic(), True)
    born: list[float] = []

    def refused() -> bool:
        """The buffer is full at once; something is sent all the time."""
        send(can232, OLD + len(born), 40)
        born.append(time.monotonic())
        told = "no frame has left the adapter for" in bridge.reason or "nothing received for" in bridge.reason
        return told and bridge.state is not State.RUNNING

    run_until(bridge, refused)
    heals(can232, bridge, device, born)


def test_a_can232_with_a_few_frames_that_nobody_acknowledges_is_restarted(can232: Bench) -> None:
    """Its buffer is not full, so it refuses nothing: its flags are all there is to see."""
    device = Can232(time.monotonic())
    can232.plug_in(device)
    bridge = started(can232.bridge(transmit=TRANSMIT))
    device.set_bus_off(time.monotonic(), True)
    send(can232, OLD, 3)
    run_until(bridge, lambda: bridge.snapshot()["counters"]["tx_frames"] == 3)
    run_until(bridge, lambda: bridge.state is not State.RUNNING)
    assert "nothing received for" in bridge.reason
    heals(can232, bridge, device, [0.0])


def test_what_stays_in_a_stuck_adapter_is_counted(can232: Bench) -> None:
    """Where closing the channel does not empty its buffer."""
    device = Can232(time.monotonic())
    can232.plug_in(device)
    bridge = started(can232.bridge(transmit=TRANSMIT))
    bridge.adapter.sending = bridge.adapter.sending._replace(kept=8)
    device.set_bus_off(time.monotonic(), True)
    send(can232, OLD, 3)
    run_until(bridge, lambda: bridge.state is not State.RUNNING)
    assert bridge.snapshot()["counters"]["tx_late"] == 3
    stopped(bridge)


@pytest.mark.parametrize("event", [Event.RESTART, Event.STOP])
def test_a_can232_that_is_never_to_be_restarted_stays_off_the_bus(
    can232: Bench, event: Event, caplog: pytest.LogCaptureFixture
) -> None:
    device = Can232(time.monotonic())
    can232.plug_in(device)
    bridge = started(can232.bridge("bitrate: 125000, restart: never", TRANSMIT))
    device.set_bus_off(time.monotonic(), True)
    send(can232, OLD, 3)
    run_until(bridge, lambda: bridge.state is State.BUS_OFF)
    assert "channel.restart is never: ip link set vcan0 down, then up" in bridge.reason
    (line,) = [record for record in caplog.records if "state=bus-off" in record.getMessage()]
    assert (line.levelno, "the adapter off its CAN bus: " in line.getMessage()) == (logging.WARNING, True)
    told = frames_on_bus(can232)
    assert told.count(error_frame(CAN_ERR_BUSOFF)) == 1
    device.set_bus_off(time.monotonic(), False)
    send(can232, OLD)
    run_until(bridge, lambda: bridge.snapshot()["counters"]["tx_dropped"]["adapter-away"] == 1)
    assert (bridge.state, bridge.next_timer()) == (State.BUS_OFF, None)
    if event is Event.RESTART:
        bridge._act_on(Verdict(event))
        run_until(bridge, lambda: bridge.snapshot()["bus_state"] == BusState.ERROR_ACTIVE.text)
    stopped(bridge)
    assert can232.frames == []
    back = [error_frame(CAN_ERR_RESTARTED), error_frame(CAN_ERR_CRTL, crtl=CRTL_ACTIVE)]
    assert frames_on_bus(can232) == (back if event is Event.RESTART else [])


def test_a_usb2can_restarts_itself(usb2can: Usb2canBench) -> None:
    device = usb2can.device_plugged_in()
    bridge = started(usb2can.bridge())
    run_until(bridge, lambda: bridge.snapshot()["bus_state"] == BusState.ERROR_ACTIVE.text)
    device.set_bus_off(time.monotonic(), True)
    run_until(bridge, lambda: bridge.snapshot()["bus_state"] == BusState.BUS_OFF.text)
    device.set_bus_off(time.monotonic(), False)
    run_until(bridge, lambda: bridge.snapshot()["bus_state"] == BusState.ERROR_ACTIVE.text)
    counters = stopped(bridge)["counters"]
    assert (counters["bus_off_restarts"], counters["reconnects"]) == (1, 0)


@pytest.mark.parametrize("restart", ["50", "never"])
def test_a_usb2can_is_taken_off_the_bus_if_it_is_not_to_restart_itself(
    usb2can: Usb2canBench, restart: str
) -> None:
    device = usb2can.device_plugged_in()
    bridge = started(usb2can.bridge(f"bitrate: 500000, restart: {restart}"))
    device.set_bus_off(time.monotonic(), True)
    run_until(bridge, lambda: bridge.state in {State.BACKOFF, State.BUS_OFF})
    assert device.chip.in_reset
    assert bridge.state is (State.BUS_OFF if restart == "never" else State.BACKOFF)
    assert frames_on_bus(usb2can).count(error_frame(CAN_ERR_BUSOFF)) == 1
    device.set_bus_off(time.monotonic(), False)
    if restart == "never":
        bridge._act_on(Verdict(Event.RESTART))
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    assert error_frame(CAN_ERR_RESTARTED) in frames_on_bus(usb2can)
    stopped(bridge)


@pytest.mark.parametrize(("restart", "state"), [("never", State.BUS_OFF), ("50", State.BACKOFF)])
def test_another_restart_that_is_reloaded_counts_for_a_bus_off_that_lasts(
    usb2can: Usb2canBench, restart: str, state: State
) -> None:
    device = usb2can.device_plugged_in()
    bridge = started(usb2can.bridge())
    device.set_bus_off(time.monotonic(), True)
    run_until(bridge, lambda: bridge.snapshot()["bus_state"] == BusState.BUS_OFF.text)
    assert bridge.state is State.RUNNING
    other = usb2can.bridge(f"bitrate: 500000, restart: {restart}")
    assert bridge.reconfigure(other.config)
    other.close()
    run_until(bridge, lambda: bridge.state is state)
    assert device.chip.in_reset
    stopped(bridge)


def test_an_adapter_that_does_not_answer_cannot_delay_the_end(
    can232: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """On a slow line answers may take longer than anybody waits; what closes it is sent all the same."""
    monkeypatch.setattr(lifecycle, "STOP_S", 0.05)
    device = Can232(time.monotonic())
    can232.plug_in(device)
    bridge = started(can232.bridge())
    device.silent = True
    stopped(bridge)
    assert "the adapter did not answer in time: its channel may still be open" in caplog.messages
    until(lambda: not device._is_open())  # it may be late, but nothing is lost with the port


def test_frames_go_on_while_settings_change(can232: Bench) -> None:
    device = Can232(time.monotonic())
    can232.plug_in(device)
    bridge = started(can232.bridge())
    ids = itertools.count(1)
    for transmit in ("{deadline: 3.0}", "{queue: 12, deadline: 3.0}", "{queue: 2000}"):
        send(can232, next(ids), 4)
        other = can232.bridge(transmit=transmit)
        assert bridge.reconfigure(other.config)
        other.close()
    run_until(bridge, lambda: bridge.snapshot()["counters"]["tx_frames"] == 12)
    other = can232.bridge(transmit="{window: 2}")
    assert not bridge.reconfigure(other.config)
    other.close()
    stopped(bridge)
    assert [frame.can_id for frame in can232.frames] == [1] * 4 + [2] * 4 + [3] * 4


class Closings:
    """Whether each closing of the channel is to wait for what the adapter has taken."""

    def __init__(self, bridge: Bridge, monkeypatch: pytest.MonkeyPatch) -> None:
        self.drains: list[bool] = []
        self._steps = bridge.adapter.close_steps
        monkeypatch.setattr(bridge.adapter, "close_steps", self._close_steps)

    def _close_steps(self, drain: bool) -> Steps:
        self.drains.append(drain)
        return self._steps(drain)


def test_only_a_stop_waits_for_what_the_adapter_has_taken(
    can232: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Anything else closes the channel to throw it away: the bus may be well again in that moment."""
    can232.plug_in(Can232(time.monotonic()))
    bridge = started(can232.bridge(transmit=TRANSMIT))
    assert next(bridge.adapter.close_steps(drain=False)).request == b"C\r"
    closings = Closings(bridge, monkeypatch)
    can232.device.set_bus_off(time.monotonic(), True)
    send(can232, OLD, 3)
    run_until(bridge, lambda: bridge.state is not State.RUNNING)
    can232.device.set_bus_off(time.monotonic(), False)
    run_until(bridge, lambda: bridge.state is State.RUNNING)
    run_until(bridge, lambda: bridge.snapshot()["bus_state"] == "error-active")
    stopped(bridge)
    assert closings.drains == [False, True]


def test_a_stop_waits_where_nothing_is_known_of_the_bus(
    can232: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    can232.plug_in(Can232(time.monotonic()))
    bridge = started(can232.bridge())
    closings = Closings(bridge, monkeypatch)
    assert bridge.snapshot()["bus_state"] is None  # not asked yet
    stopped(bridge)
    assert closings.drains == [True]


def test_a_stop_does_not_wait_for_an_error_passive_adapter(
    can232: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    can232.plug_in(Can232(time.monotonic()))
    bridge = started(can232.bridge())
    closings = Closings(bridge, monkeypatch)
    can232.device.set_error_counters(time.monotonic(), 130, 3)
    run_until(bridge, lambda: bridge.snapshot()["bus_state"] == "error-passive")
    stopped(bridge)
    assert closings.drains == [False]


@pytest.mark.parametrize(
    ("restart", "verdict"),
    [
        (Restart.ITSELF, None),
        (After(2.5), (Event.SILENT, 2.5, True)),  # the pause is that of the configuration, not the back-off's
        (Restart.NEVER, (Event.BUS_OFF, None, True)),
    ],
)
@pytest.mark.parametrize("keeps_buffer", [False, True])
def test_what_bus_off_leads_to(
    restart: Restart | After, verdict: tuple[object, ...] | None, keeps_buffer: bool
) -> None:
    bus = SimpleNamespace(interface="socketcan", channel="vcan0")
    config: Any = SimpleNamespace(channel=SimpleNamespace(restart=restart), bus=bus)
    adapter: Any = SimpleNamespace(sending=Sending(keeps_buffer=keeps_buffer))
    found = Recovery(config, adapter).bus_off("bus-off")
    assert (found and (found.event, found.pause_s, found.off_bus)) == verdict
    assert found is None or found.reason.startswith("bus-off; ")
    if isinstance(restart, After):
        assert found is not None
        assert ("so that nothing is sent late" in found.reason) != keeps_buffer
        assert ("that may be sent late" in found.reason) == keeps_buffer


def test_frames_that_were_thrown_away_are_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    adapter: Any = SimpleNamespace(discarded=0)
    recovery = Recovery(cast("Any", None), adapter)
    recovery.closed()
    assert caplog.messages == []
    adapter.discarded = 3
    recovery.closed()
    recovery.closed()
    (line,) = caplog.messages
    assert line.startswith("3 frames did not leave the adapter before its channel was closed")
