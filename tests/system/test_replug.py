"""An adapter is pulled out and plugged in again, many times, while frames flow both ways.

Not QEMU's chip: that crashes where it is unplugged while data comes.
"""

import random
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rig import Rig, no_huge_pages, wait_until
from test_can232 import balanced
from wired import (
    Life,
    WiredAdapter,
    assert_flat,
    find_device,
    find_terminal,
    in_order,
    numbered_frames,
    plugged,
    wait_flowing,
    wait_terminal,
)

pytestmark = pytest.mark.timeout(900)

STEADY, BURST = "1ABCDEF0", "1ABCDEF1"  # identifiers
STEADY_GAP_MS = 20
BURST_LENGTH = 300  # takes longer than the deadline
FLOW = 5  # frames each way that show that it runs
DEADLINE = 0.5  # seconds
WARM_UP = 5  # cycles
FAKE = "PY000021"  # serial number


def configuration(adapter: str, port: str, bus: str) -> dict[str, Any]:
    settings: dict[str, Any] = {"type": adapter, "port": port}
    if adapter == "can232":
        settings["baudrate"] = 115_200
    return {
        "adapter": settings,
        "channel": {"bitrate": 125_000},
        "bus": {"channel": bus},
        "transmit": {"deadline": DEADLINE},
    }


def wait_return(chip: WiredAdapter, node: Callable[[], Path | None]) -> tuple[float, float]:
    """Seconds until what the bridge opens is there, and from then on until the first frame has come through.

    It is not asked for its state: that would slow it down.
    """
    plugged_at = time.time()
    wait_until(node, "the device to be there")
    there_at = time.time()
    wait_until(lambda: chip.life.first_at, "the first frame")
    return there_at - plugged_at, chip.life.first_at - there_at


def tell(what: str, seconds: list[float]) -> None:
    """For those who read along: all of them; the median."""
    median = statistics.median(seconds)
    print(f"{what}: {' '.join(f'{n:.2f}' for n in seconds)}; median {median:.3f} s")


def assert_sent(lives: list[Life], born: dict[str, float], counters: dict[str, Any]) -> None:
    """In order, none twice, none too old; what the bridge counts agrees with what the devices have taken."""
    for life in lives:
        too_old = [frame for frame in life.sent if born[frame] < life.since - DEADLINE]
        assert too_old == [], f"older than {DEADLINE:g} s when the adapter was plugged in"
        assert life.handed_late(born, DEADLINE) == []
    for identifier in (STEADY, BURST):  # who listens sees two senders in any order
        sent = [frame for life in lives for frame in life.sent if frame.startswith(identifier)]
        assert in_order(sent, (frame for frame in born if frame.startswith(identifier)))
    assert counters["bus_read"] == len(born)
    dropped = counters["tx_dropped"]
    taken = sum(life.taken for life in lives)
    assert counters["tx_frames"] <= taken <= counters["tx_frames"] + dropped["unanswered"]
    assert dropped["stale"] > 100
    assert dropped["adapter-away"] > 100


@pytest.mark.parametrize(
    ("adapter", "raw", "cycles"),
    [
        pytest.param("can232", False, 8, id="can232"),
        pytest.param("usb2can", False, 8, id="usb2can"),
        pytest.param("usb2can", True, 8, id="usb2can-libusb"),
        pytest.param("can232", False, 50, id="can232-50", marks=pytest.mark.long),
        pytest.param("usb2can", False, 25, id="usb2can-25", marks=pytest.mark.long),
        pytest.param("usb2can", True, 25, id="usb2can-libusb-25", marks=pytest.mark.long),
    ],
)
def test_unplug_and_plug_while_frames_flow(rig: Rig, adapter: str, raw: bool, cycles: int) -> None:
    """Frames STEADY#… go all the time; of the BURST#… many still wait when the cable is pulled."""
    no_huge_pages()
    near, draw = rig.vcan(), random.Random(1)
    find = find_device if raw else find_terminal

    def node() -> Path | None:
        return find(FAKE)

    resources, returns = [], []
    with plugged(adapter, FAKE) as chip:
        chip.hear(numbered_frames())
        port = f"usb://0403:6001/{FAKE}" if raw else str(wait_terminal(FAKE))
        dump = rig.candump(near)
        bridge = rig.bridge(configuration(adapter, port, near))
        bridge.wait_state("running")
        steady = ("-e", "-I", STEADY, "-L", "8", "-D", "i")
        generator = rig.cangen(near, 10_000_000, *steady, gap_ms=STEADY_GAP_MS)
        for cycle in range(cycles):
            wait_flowing(bridge, FLOW)
            resources.append(bridge.resources())
            burst = rig.play(near, [f"{BURST}#{cycle:08X}{n:08X}" for n in range(BURST_LENGTH)])
            assert burst.wait() == 0
            chip.unplug()
            back_at = time.monotonic() + draw.uniform(0, 2 * DEADLINE)  # what waits is too old, or is not
            bridge.wait_status(lambda status: status["state"] != "running", "the loss to be noticed")
            wait_until(lambda: not node(), "the device to be gone")
            time.sleep(max(0.0, back_at - time.monotonic()))
            chip.plug()
            returns.append(wait_return(chip, node))
        wait_flowing(bridge, FLOW)
        resources.append(bridge.resources())
        generator.stop()
        chip.hear(())
        bridge.wait_status(lambda status: status["queued"] == 0, "an empty queue")
        counters = balanced(bridge.read_status())
        bridge.stop_cleanly()
        wait_terminal(FAKE)  # the kernel's driver has it again

    tell("from the plug to the device being there", [there_s for there_s, _ in returns])
    tell("from there to the first frame", [flowing_s for _, flowing_s in returns])
    log = dump.stamped
    born = {frame: stamp for stamp, frame in log if frame.startswith((STEADY, BURST))}
    assert_sent(chip.lives, born, counters)
    received = [frame for _, frame in log if frame not in born]
    assert len(received) == counters["rx_frames"] > 0
    assert in_order(received, [frame for life in chip.lives for frame in life.heard])
    assert [life.device.report().get("violations", []) for life in chip.lives] == [[]] * (cycles + 1)
    assert chip.eeprom.writes <= 1
    assert_flat(resources[WARM_UP:])
