"""Frames both ways through each firmware that speaks almost a CAN232's protocol: real bridge, relay, pty."""

import math
import os
import time
from collections import Counter

import pytest
from benches.bridge import LIMIT_S, run_until, started, stopped
from benches.families import FAMILIES, FamilyBench, Traffic

from bridged.adapters import firmware
from bridged.adapters.base import Confirms
from bridged.simulators.faults import Fault
from bridged.simulators.sja1000 import Frame

LONG = "CAN_BRIDGE_LONG" in os.environ  # ./dev test long
COUNT = 5000 if LONG else 200
COUNTERS = {
    Confirms.SENT: "tx_frames",
    Confirms.QUEUED: "tx_queued",
    Confirms.ALWAYS: "tx_unconfirmed",
    Confirms.NOTHING: "tx_unconfirmed",
}


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
    assert ("another order" in status["adapter"]["sent_means"]) is not profile.in_order
    if profile.in_order:
        assert bench.frames == traffic.sendable
    assert Counter(bench.frames) == Counter(traffic.sendable)
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


OUTAGE_S = 10.0 if LONG else 1.0
DEADLINE_S, STUCK_S = 0.3, 0.5  # the second is how long an adapter may be stuck, see recovery.stuck_s()
LATE_S = 0.3  # a busy machine
STOPS_WITHIN_S = 2.0


@pytest.mark.parametrize("name", sorted(FAMILIES.keys() - {"slcanpty"}))  # which has no CAN bus of its own
def test_nobody_acknowledges_for_a_time(family_bench: FamilyBench, name: str) -> None:
    """What leaves the adapter afterwards is young, or counted as in doubt; then it works again.

    Also while it lasts the bridge stops as usual.
    """
    family, bench = FAMILIES[name]._replace(bitrate=125_000), family_bench
    born: list[float] = []
    sent_at: list[float] = []
    ages: list[float] = []

    def on_the_bus(frame: Frame) -> None:
        sent_at.append(born[int.from_bytes(frame.data)])
        ages.append(time.monotonic() - sent_at[-1])

    bench.on_bus = on_the_bus
    bridge = started(bench.family(family, transmit={"deadline": DEADLINE_S}, health={"interval": 0.1}))

    def send_until(end: float) -> bool:
        """A frame each 5 ms, as long as that lasts."""
        now = time.monotonic()
        if not born or now > born[-1] + 0.005:
            born.append(now)
            bench.send(Frame(0x100, False, False, 8, (len(born) - 1).to_bytes(8)))
        return now > end

    def outage(seconds: float) -> None:
        bench.befall(Fault("noack", 0, seconds))
        end = time.monotonic() + seconds
        run_until(bridge, lambda: send_until(end))

    outage(OUTAGE_S)
    healed = time.monotonic()
    run_until(bridge, lambda: send_until(math.inf) or (sent_at and sent_at[-1] > healed))
    bench.befall(Fault("noack", 0, LIMIT_S))
    end = time.monotonic() + 0.3
    run_until(bridge, lambda: send_until(end))
    stopping = time.monotonic()
    status = stopped(bridge)
    assert time.monotonic() - stopping < STOPS_WITHIN_S
    bench.pull_out()
    counters, device = status["counters"], bench.device
    old = [age for age in ages if age > DEADLINE_S + STUCK_S + LATE_S]
    in_doubt = counters["tx_late"] + counters["tx_unconfirmed"] + counters["tx_dropped"]["unanswered"]
    assert len(old) <= min(in_doubt, device.transmit_room + 1)
    told = any("acknowledges" in text for text in bridge.adapter.cautions)
    assert told or not counters["tx_unconfirmed"]
    assert counters["reconnects"] <= OUTAGE_S / STUCK_S + 2
    assert device.effects == []


@pytest.mark.parametrize("room", [1, 2, 8, 200] if LONG else [1, 200])
@pytest.mark.parametrize("name", FAMILIES)
def test_its_buffer_has_another_size(family_bench: FamilyBench, name: str, room: int) -> None:
    """Whose answers can be believed loses nothing, or says so. No frame is another one, or comes twice."""
    family, bench = FAMILIES[name], family_bench
    family = family._replace(options=(*family.options, "--transmit-room", str(room)), bitrate=125_000)
    bridge = started(bench.family(family))
    traffic = Traffic(bench, bridge, family, 200)
    bench.bus.far.setblocking(True)
    bench.send(*traffic.to_device)
    run_until(bridge, lambda: bridge.snapshot()["counters"]["bus_read"] == 200)
    run_until(bridge, lambda: not bridge.snapshot()["queued"] and not bench.device.report()["buffered"])
    counters = stopped(bridge)["counters"]
    bench.pull_out()
    rest = iter(traffic.sendable)
    if firmware.load(family.firmware).in_order:
        assert all(frame in rest for frame in bench.frames)
    assert Counter(bench.frames) <= Counter(traffic.sendable)
    assert counters["tx_frames"] <= len(bench.frames)
    if counters["tx_queued"]:
        assert counters["tx_queued"] == len(bench.frames)
    refused = sum(counters["tx_dropped"].values()) - counters["tx_dropped"]["remote-frame"]
    if not counters["tx_unconfirmed"]:
        assert len(traffic.sendable) - len(bench.frames) <= refused
    assert bench.device.effects == []
