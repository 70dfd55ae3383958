"""Frames both ways through each firmware that speaks almost a CAN232's protocol: real bridge, relay, pty."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from benches.bridge import started, stopped
from benches.families import FAMILIES, FamilyBench, Traffic

from bridged.adapters import firmware
from bridged.adapters.base import Confirms

LONG = "CAN_BRIDGE_LONG" in os.environ  # ./dev test long
COUNT = 5000 if LONG else 200
COUNTERS = {
    Confirms.SENT: "tx_frames",
    Confirms.QUEUED: "tx_queued",
    Confirms.ALWAYS: "tx_unconfirmed",
    Confirms.NOTHING: "tx_unconfirmed",
}


@pytest.fixture
def family_bench(tmp_path: Path) -> Iterator[FamilyBench]:
    with contextlib.closing(FamilyBench(tmp_path)) as made:
        yield made


@pytest.mark.parametrize("name", FAMILIES)
def test_mixed_frames_both_ways(family_bench: FamilyBench, name: str) -> None:
    """All that its firmware can send, exactly and in order; the others are dropped with their reason.

    Each is counted as what that firmware vouches for.
    """
    family, bench = FAMILIES[name], family_bench
    bridge = started(bench.family(family))
    traffic = Traffic(bench, bridge, family, COUNT)
    traffic.run()
    status = stopped(bridge)
    bench.pull_out()
    counters, device = status["counters"], bench.device
    profile = firmware.load(family.firmware)
    assert status["adapter"]["firmware"] == family.firmware
    assert bench.frames == traffic.sendable
    assert counters[COUNTERS[profile.sending.confirms]] == len(traffic.sendable)
    told = {reason: n for reason, n in counters["tx_dropped"].items() if n}
    unsendable = len(traffic.to_device) - len(traffic.sendable)
    assert told == ({"remote-frame": unsendable} if unsendable else {})
    assert (counters["bus_read"], counters["reconnects"]) == (COUNT, 0)
    if device.counters.frames_lost == 0:
        assert traffic.received == traffic.to_host
    else:  # a canable1 while its host is busy: lost in the device, and no other frame made of it
        rest = iter(traffic.to_host)
        assert all(frame in rest for frame in traffic.received)
        assert family.firmware == "canable1"
    assert device.effects == []
