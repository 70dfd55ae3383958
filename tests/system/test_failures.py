"""The adapter fails while frames flow both ways: the bridge says what is wrong, and finds its way back.

The simulator is a thread of the test, so that a fault begins when the test says so.
"""

import random
import re
import threading
import time
from typing import Any

import pytest
from rig import Rig, wait_until
from test_can232 import balanced
from wired import UART_RATE, in_order, wait_flowing

from bridged.simulators.can232 import Can232
from bridged.simulators.can232_memory import Eeprom
from bridged.simulators.faults import Fault
from bridged.simulators.serve import Simulator, mixed_frames, record_line
from bridged.simulators.uart import Uart
from bridged.simulators.usb2can import STOP_GRACE_S, Usb2can

pytestmark = pytest.mark.timeout(300)

STEADY = "1ABCDEF0"  # identifier of the frames to the adapter
STEADY_GAP_MS = 20
TRAFFIC_FPS = 50
FLOW = 50  # frames each way that show that it runs: more than fit into a buffer of the adapter
BITRATE = 125_000
SEED = 5

SILENT = "state=closing: the adapter stopped answering"
NO_POWER = "no answer to V on .*: is the adapter powered"
CLOSED = "state=closing: the adapter's channel is closed: it was reset, or lost its power"
BOOT = "state=closing: the adapter is in mode BOOT: it was reset"
REFUSES = "adapter refuses frames; its status: "
REFUSES_ALL = "refuses (every|all)"
NOISE = "(?i)noise"
LISTEN_ONLY = "listen-only"
NO_REASON = "adapter refuses frames; its status: no flags"  # all that a CAN232 in listen-only mode tells


class Scene:
    """A bridge and a simulated adapter on a terminal, amid traffic both ways."""

    def __init__(self, rig: Rig, device: Can232 | Usb2can) -> None:
        near, link = rig.vcan(), rig.directory / "adapter"
        self.sent: list[str] = []  # what the adapter has put on its bus
        self.simulator = Simulator(
            device,
            link=link,
            on_frame=lambda frame: self.sent.append(record_line(frame).strip()),
            traffic_fps=TRAFFIC_FPS,
            rng=random.Random(SEED),
        )
        self._thread = threading.Thread(target=self.simulator.run)
        self._thread.start()
        wait_until(link.exists, "the adapter's port")
        self._dump = rig.candump(near)
        settings: dict[str, Any] = {"type": "usb2can", "port": str(link)}
        if isinstance(device, Can232):
            settings |= {"type": "can232", "baudrate": UART_RATE}
        self.bridge = rig.bridge(
            {"adapter": settings, "channel": {"bitrate": BITRATE}, "bus": {"channel": near}}
        )
        self.bridge.wait_state("running")
        steady = ("-e", "-I", STEADY, "-L", "8", "-D", "i")
        self._sender = rig.cangen(near, 10_000_000, *steady, gap_ms=STEADY_GAP_MS)

    def stop(self) -> None:
        """The adapter; idempotent."""
        self.simulator.stop()
        self._thread.join()

    def assert_end(self) -> None:
        """Nothing is on either bus that was not on the other, in its order; no frame is forgotten."""
        self._sender.stop()
        counters = balanced(self.bridge.wait_status(lambda status: status["queued"] == 0, "an empty queue"))
        self.bridge.stop_cleanly()
        self.stop()
        frames = self._dump.frames
        ours = [frame for frame in frames if frame.startswith(STEADY)]  # no two are alike
        assert counters["bus_read"] == len(ours)
        assert in_order(self.sent, ours)
        state: Any = self.simulator.state()
        assert state.get("violations", []) == []
        taken = state["counters"]["frames_taken"]
        assert counters["tx_frames"] <= taken <= counters["tx_frames"] + counters["tx_dropped"]["unanswered"]
        traffic = mixed_frames(random.Random(SEED))
        heard = [record_line(next(traffic)).strip() for _ in range(state["traffic"]["made_up"])]
        assert in_order((frame for frame in frames if not frame.startswith(STEADY)), heard)


def assert_survives(rig: Rig, device: Can232 | Usb2can, fault: Fault, cause: str) -> None:
    """A line of the log tells the cause; when the fault is over frames flow again, both ways."""
    scene = Scene(rig, device)
    try:
        bridge = scene.bridge
        wait_flowing(bridge, FLOW)
        before = len(bridge.err)
        scene.simulator.begin(fault)
        time.sleep(fault.duration_s)
        wait_flowing(bridge, FLOW)
        told = bridge.err[before:]
        scene.assert_end()
        assert re.search(cause, told), f"the log does not say {cause!r}:\n{told}"
    finally:
        scene.stop()


CAN232 = {
    Fault("silence", 0, 4): SILENT,
    Fault("drop", 0, 4): SILENT,
    Fault("poweroff", 0, 4): f"{SILENT}|{NO_POWER}",  # the second if it is tried before the power is back
    Fault("reset", 0): CLOSED,
    Fault("garbage", 0, 10): NOISE,
    Fault("refuse", 0, 4): REFUSES,
    Fault("refuseall", 0, 4): REFUSES_ALL,
    Fault("listenonly", 0): NO_REASON,
    Fault("listenonly", 0, 4): NO_REASON,
}
USB2CAN = {
    Fault("silence", 0, 4): SILENT,
    Fault("drop", 0, 4): SILENT,
    Fault("poweroff", 0, 4): SILENT,
    Fault("reset", 0): BOOT,
    Fault("garbage", 0, 10): NOISE,
    Fault("refuse", 0, 4): REFUSES,
    Fault("listenonly", 0): LISTEN_ONLY,
    Fault("listenonly", 0, 4): LISTEN_ONLY,
}


def name(fault: Fault) -> str:
    return f"{fault.kind}-{fault.duration_s:g}s" if fault.duration_s else fault.kind


@pytest.mark.parametrize("fault", CAN232, ids=name)
def test_can232(rig: Rig, fault: Fault) -> None:
    device = Can232(time.monotonic(), uart=Uart(UART_RATE))
    assert_survives(rig, device, fault, CAN232[fault])


def test_can232_that_opens_in_listen_only_after_a_reset(rig: Rig) -> None:
    """As somebody has set it up with Q2: its channel is open, only no frame goes out."""
    eeprom = Eeprom(auto_poll=True, auto_start=2, bitrate=BITRATE)
    device = Can232(time.monotonic(), uart=Uart(UART_RATE), eeprom=eeprom)
    assert_survives(rig, device, Fault("reset", 0), NO_REASON)


@pytest.mark.parametrize("fault", USB2CAN, ids=name)
def test_usb2can(rig: Rig, fault: Fault) -> None:
    device = Usb2can(time.monotonic(), stop_grace_s=STOP_GRACE_S)
    assert_survives(rig, device, fault, USB2CAN[fault])
