"""The end of a bridge on a CAN232."""

import time

from benches.bridge import FRAME, Bench, run_until, started, stopped

from bridged.simulators.can232 import TRANSMIT_FIFO, Can232


def test_what_it_has_taken_is_on_the_bus_before_it_is_closed(bench: Bench) -> None:
    bench.plug_in(Can232(time.monotonic()))
    bridge = started(bench.bridge("bitrate: 10000"))
    for n in range(TRANSMIT_FIFO):
        bench.bus.far.send(FRAME.pack(n, 8, bytes(8)))
    run_until(bridge, lambda: bridge.snapshot()["counters"]["tx_frames"] == TRANSMIT_FIFO)
    assert bridge.snapshot()["channel_open"]
    assert not stopped(bridge)["channel_open"]
    assert [f.can_id for f in bench.frames] == list(range(TRANSMIT_FIFO))


def test_a_stop_does_not_need_an_answer(bench: Bench) -> None:
    bench.plug_in(Can232(time.monotonic()))
    bridge = started(bench.bridge())
    run_until(bridge, lambda: bridge.snapshot()["bus_state"] == "error-active")
    bench.device.silent = True
    assert stopped(bridge)["channel_open"]  # for all that is known
    assert bridge.reason == ""


def test_frames_of_the_adapter_go_on_until_its_channel_is_closed(bench: Bench) -> None:
    """Before that it is given time to send what it has taken: 80 ms here."""
    bench.plug_in(Can232(time.monotonic()), traffic_fps=500)
    bridge = started(bench.bridge("bitrate: 50000"))
    bench.bus.far.recv(16)
    assert stopped(bridge)["counters"]["rx_dropped"]["not-running"] == 0
