"""Bus states of a simulated adapter as a real candump shows them, in its words for the kernel's drivers."""

import re
from pathlib import Path
from typing import Any

import pytest
from rig import Process, Rig

pytestmark = pytest.mark.timeout(600)

ADAPTERS: dict[str, dict[str, Any]] = {"can232": {"baudrate": 115200}, "usb2can": {}}
BACK = "controller-problem{back-to-error-active}"


def configuration(adapter: str, port: Path, bus: str, **health: Any) -> dict[str, Any]:
    return {
        "adapter": {"type": adapter, "port": str(port)} | ADAPTERS[adapter],
        "channel": {"bitrate": 500_000},
        "bus": {"channel": bus},
        "health": health,
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
