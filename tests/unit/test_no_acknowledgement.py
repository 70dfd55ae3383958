"""Nobody acknowledges frames for a while, then somebody does: on the simulator of each firmware."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from benches.bridge import ContractBench, run_until, started, stopped

from bridged.adapters import firmware
from bridged.simulators import simulator
from bridged.simulators.faults import Fault
from bridged.simulators.sja1000 import Frame

NO_ONE_S = 1.5
DEADLINE_S = 0.5
EVERY_S = 0.01
WITH_A_CONTROLLER = [name for name in firmware.NAMES if name not in {"can232", "generic", "slcanpty"}]


@pytest.fixture
def bench(
    tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[ContractBench]:
    monkeypatch.setattr(simulator(request.param), "ADAPTER", {"type": "can232"})
    with contextlib.closing(ContractBench(tmp_path, request.param)) as made:
        yield made


@pytest.mark.parametrize("bench", WITH_A_CONTROLLER, indirect=True)
def test_nobody_acknowledges_for_a_while(bench: ContractBench) -> None:
    """No frame is late but those that the status does not vouch for; WeAct's, which it does, never."""
    bench.plug_in(bench.new_device())
    bridge = started(bench.bridge(deadline_s=DEADLINE_S))
    began = time.monotonic()
    healed = began + NO_ONE_S
    bench.befall(Fault("noack", 0, NO_ONE_S))
    born: list[float] = []
    late: list[Frame] = []
    seen = 0

    def is_over() -> bool:
        nonlocal seen
        now = time.monotonic()
        if now < healed and now - began > len(born) * EVERY_S:
            born.append(now)
            bench.send(Frame(0x100 + len(born), True, False, 0, b""))
        new, seen = bench.frames[seen:], len(bench.frames)
        late.extend(frame for frame in new if now - born[frame.can_id - 0x101] > DEADLINE_S + 0.1)
        return now > healed + 1.0

    run_until(bridge, is_over)
    status = stopped(bridge)
    counters = status["counters"]
    bench.pull_out()
    assert len(born) > 20
    unanswered = counters["tx_dropped"]["unanswered"]
    assert len(late) <= counters["tx_queued"] + counters["tx_unconfirmed"] + unanswered
    assert len(late) <= firmware.load(bench.name).buffer + 3  # those in its controller
    assert status["channel_open"] is (bench.name == "slcanuino")
    if bench.name == "weact":
        assert late == []
