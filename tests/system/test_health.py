"""Bus states of a simulated adapter as a real candump shows them, in its words for the kernel's drivers."""

import re
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from rig import Process, Rig, wait_until

pytestmark = pytest.mark.timeout(600)

ADAPTERS: dict[str, dict[str, Any]] = {"can232": {"baudrate": 115200}, "usb2can": {}}
BACK = "controller-problem{back-to-error-active}"


def configuration(adapter: str, port: Path, bus: str, **channel: Any) -> dict[str, Any]:
    return {
        "adapter": {"type": adapter, "port": str(port)} | ADAPTERS[adapter],
        "channel": {"bitrate": 500_000} | channel,
        "bus": {"channel": bus},
    }


def explained(dump: Process) -> list[str]:
    """What `candump -e` said of each error frame."""
    texts = re.findall(r"ERRORFRAME\n((?:\t.*\n)+)", dump.out)
    return ["; ".join(line.strip() for line in text.splitlines()) for text in texts]


def story(rig: Rig, adapter: str, *faults: str, frames: int) -> list[str]:
    """The error frames of an adapter that these things happen to, in candump's words."""
    bus = rig.vcan()
    dump = rig.start("candump", "-e", f"{bus},0~0,#FFFFFFFF")
    options = [option for fault in faults for option in ("--fault", fault)]
    _, port = rig.simulate(None, *options, adapter=adapter)
    bridge = rig.bridge(configuration(adapter, port, bus))
    bridge.wait_state("running")
    dump.wait_ready(lambda: len(explained(dump)) >= frames, f"{frames} error frames")
    status = bridge.read_status()
    assert status["counters"]["error_frames"] >= frames
    assert status["counters"]["error_frames_lost"] == 0
    bridge.stop_cleanly()
    return explained(dump)


def test_usb2can_warning_passive_bus_off_and_restart(rig: Rig) -> None:
    assert story(rig, "usb2can", "warning@20+3", "passive@26+3", "busoff@32+3", frames=7) == [
        "controller-problem{tx-error-warning}; error-counter-tx-rx{{100}{3}}",
        BACK,
        "controller-problem{tx-error-passive}; error-counter-tx-rx{{130}{3}}",
        BACK,
        "bus-off",
        "restarted-after-bus-off",
        BACK,
    ]


def test_can232_says_what_happened(rig: Rig) -> None:
    """Its flags know no direction, and are over when nothing has happened for a second."""
    assert story(rig, "can232", "warning@20+60", "passive@26+60", frames=4) == [
        "controller-problem{rx-error-warning,tx-error-warning}",
        BACK,
        "controller-problem{rx-error-passive,tx-error-passive}",
        BACK,
    ]


@pytest.mark.parametrize("adapter", ADAPTERS)
def test_bus_off_until_the_interface_is_up_again(rig: Rig, adapter: str) -> None:
    """`channel.restart: never`. A CAN232 cannot tell: a frame that does not leave it tells."""
    near, far = rig.vcan(), rig.vcan()
    dump = rig.start("candump", "-e", f"{near},0~0,#FFFFFFFF")
    _, port = rig.simulate(far, "--fault", "busoff@25+10", adapter=adapter)
    good_again = time.monotonic() + 25 + 10
    bridge = rig.bridge(configuration(adapter, port, near, restart="never"))
    bridge.wait_state("running")
    arrived = rig.candump(far)

    def off() -> bool:
        rig.cansend(near, "123#01")
        return "state=leaving" in bridge.err

    bridge.wait_ready(off, "bus-off")
    status = bridge.wait_state("bus-off")
    assert f"channel.restart is never: ip link set {near} down, then up" in status["reason"]
    before = arrived.count
    rig.cansend(near, "123#02")
    bridge.wait_status(lambda s: s["counters"]["tx_dropped"]["adapter-away"] >= 1, "the frame to be dropped")
    wait_until(lambda: time.monotonic() > good_again, "a good bus")
    for state in ("down", "up"):
        subprocess.run(["ip", "link", "set", near, state], check=True)
        bridge.wait_ready(lambda s=state: f"{near} is {s}" in bridge.err, f"{near} to be {state}")  # type: ignore[misc]
    bridge.wait_state("running")
    wait_until(lambda: arrived.count > before or not rig.cansend(near, "123#03"), "a frame to arrive")
    assert not {"123#01", "123#02"} & set(arrived.frames[before:])
    assert "bus-off" in explained(dump)
    assert "state=bus-off: the bridge has taken the adapter off its CAN bus" in bridge.err
    bridge.stop_cleanly()
