"""USB2CAN to SocketCAN and back through an FTDI chip, by libusb and by the kernel's ftdi_sio.

Behind the chip `ftdi0` the adapter is simulated on the host, so that it keeps up with a real one at 1 Mbit/s;
behind other chips it is simulated in the guest, with its CAN side on a second vcan.
"""

import itertools
import json
import random
import time
from pathlib import Path
from typing import Any

import pytest
from rig import HOST, Bridge, Candump, Process, Rig, assert_same_frames, mixed_frames, receivers, wait_until
from test_can232 import PATIENT, balanced
from wired import in_order, plugged, wait_terminal

from bridged.simulators import serve

pytestmark = pytest.mark.timeout(600)

BOTH_PORTS = pytest.mark.parametrize("raw", [True, False], ids=["libusb", "tty"])
FRAMES = 20_000
FULL_BUS = 8000  # frames a second of 1 Mbit/s
SEED = 7
FAKE = "PY000011"  # serial number


def address(serial_number: str, *, raw: bool) -> str:
    """The chip as a configuration names it."""
    return f"usb://0403:6001/{serial_number}" if raw else str(wait_terminal(serial_number))


def configuration(port: str, bus: str, **transmit: Any) -> dict[str, Any]:
    return {
        "adapter": {"type": "usb2can", "port": port},
        "channel": {"bitrate": 1_000_000},
        "bus": {"channel": bus},
        "transmit": PATIENT | transmit,
    }


def traffic(count: int, seed: int = SEED) -> list[str]:
    """What a simulated bus carries with --mixed, --traffic, --count and --seed."""
    frames = serve.mixed_frames(random.Random(seed))
    return [serve.record_line(next(frames)).strip() for _ in range(count)]


class Adapter:
    """A simulated USB2CAN."""

    def __init__(self, process: Process, state: Path, record: Path) -> None:
        self._process, self._state, self._record = process, state, record

    @classmethod
    def on_host(cls, rig: Rig, *options: object) -> "Adapter":
        """Behind the chip `ftdi0`, at full speed."""
        name = f"usb2can-{len(list(HOST.glob('*.argv')))}"
        files = (HOST / f"{name}.state", HOST / f"{name}.record")
        process = rig.host_simulate("--state", files[0].name, "--record", files[1].name, *map(str, options))
        return cls(process, *files)

    @classmethod
    def in_guest(cls, rig: Rig, bus: str, line: Path) -> "Adapter":
        """At the far end of a chip, its CAN side on the interface."""
        files = (rig.directory / f"{bus}.state", rig.directory / f"{bus}.record")
        options = ("--line", line, "--bus", bus, "--state", files[0], "--record", files[1])
        process = rig.start(*rig.command, "simulate", "usb2can", *options)
        process.wait_ready(lambda: receivers(bus), "the simulated adapter to listen")
        return cls(process, *files)

    @property
    def recorded(self) -> list[str]:
        """What it has put on its bus."""
        return self._record.read_text().split()

    def wait_recorded(self, count: int) -> list[str]:
        """What it has put on its bus, once it is so much."""
        wait_until(lambda: self._record.read_bytes().count(b"\n") >= count, f"{count} frames on its bus", 300)
        return self.recorded

    def state(self) -> dict[str, Any]:
        self._state.unlink(missing_ok=True)
        self._process.user_signal()
        wait_until(self._state.exists, "the simulator's state")
        return dict(json.loads(self._state.read_text()))

    def wait_traffic(self) -> dict[str, int]:
        """Wait until all of --count has been on its bus; its counters."""

        def counters() -> dict[str, int]:
            state = self.state()
            done = state["traffic"]["made_up"] == state["traffic"]["count"]
            return dict(state["counters"]) if done else {}

        return wait_until(counters, "the traffic to end", 300)

    def stop(self) -> dict[str, Any]:
        """Its state at the end: the manual was followed."""
        self._state.unlink(missing_ok=True)
        assert self._process.stop() == 0, str(self._process)
        state: dict[str, Any] = json.loads(self._state.read_text())
        assert state["violations"] == []
        return state

    def stop_closed(self) -> dict[str, Any]:
        """End it after the bridge: mode CONFIG, the controller off the bus (chapter III), nothing lost."""
        state = self.stop()
        assert (state["state"], state["mode_register"] & 1, state["waiting"]) == ("config", 1, 0)
        assert (state["host_lost"], state["counters"]["frames_discarded"]) == (0, 0)
        return state


def assert_received(bridge: Bridge, frames: list[str], seen: dict[str, int], expected: list[str]) -> None:
    """All that was on the device's bus, but for what the device lost, and said so (`seen`: its counters).

    What comes before the bridge knows that the adapter runs is not forwarded, but counted.
    """
    counters = balanced(bridge.read_status())
    early = counters["rx_dropped"]["not-running"]
    assert seen["frames_received"] + seen["frames_lost"] == len(expected)
    assert (counters["decoded"], sum(counters["rx_dropped"].values())) == (seen["frames_received"], early)
    assert (counters["rx_overruns"] > 0) == (seen["frames_lost"] > 0)
    if seen["frames_lost"]:
        assert in_order(frames, expected)
    else:
        assert_same_frames(frames, expected[early:])


def wait_received(bridge: Bridge, dump: Candump, seen: dict[str, int], others: int = 0) -> None:
    """Wait until all that the device has received is on the bus, together with so many other frames."""
    received = seen["frames_received"]
    status = bridge.wait_status(lambda s: s["counters"]["decoded"] >= received, "all frames to be decoded")
    count = status["counters"]["rx_frames"] + others
    wait_until(lambda: dump.count >= count, "all frames to be on the bus")


def assert_sent(bridge: Bridge, count: int) -> None:
    """All frames of the bus were taken by the adapter, none dropped or handed back."""
    status = bridge.wait_status(lambda s: s["counters"]["tx_frames"] >= count, f"{count} frames to be taken")
    counters = balanced(status)
    assert counters["tx_frames"] == counters["bus_read"] == count
    assert counters["tx_returned"] == sum(counters["tx_dropped"].values()) == 0


def tell_rate(what: str, count: int, interval_s: float) -> None:
    """For those who read along: no test depends on it."""
    print(f"{what}: {count} frames, {count / interval_s:.0f} a second")


@BOTH_PORTS
def test_each_way_at_1_mbit(rig: Rig, raw: bool) -> None:
    chip, near = rig.chip("ftdi0"), rig.vcan()
    port = address(chip.serial_number, raw=raw)
    dump = rig.candump(near)
    adapter = Adapter.on_host(rig, "--mixed", "--traffic", FULL_BUS, "--count", FRAMES, "--seed", SEED)
    bridge = rig.bridge(configuration(port, near))
    bridge.wait_state("running")
    seen = adapter.wait_traffic()
    wait_received(bridge, dump, seen)
    assert_received(bridge, dump.finish(0), seen, traffic(FRAMES))
    log = dump.stamped
    tell_rate("device to bus", len(log), log[-1][0] - log[0][0])

    there = mixed_frames(FRAMES, seed=1)
    begun = time.monotonic()
    player = rig.play(near, there)
    assert_same_frames(adapter.wait_recorded(FRAMES), there)
    tell_rate("bus to device", FRAMES, time.monotonic() - begun)
    assert player.wait() == 0
    assert_sent(bridge, FRAMES)
    bridge.stop_cleanly()
    chip.wait_tty()
    adapter.stop_closed()


@BOTH_PORTS
def test_both_ways_at_once(rig: Rig, raw: bool) -> None:
    chip, near, count = rig.chip("ftdi0"), rig.vcan(), 3000
    port = address(chip.serial_number, raw=raw)
    back = traffic(count)
    there = [frame for frame in mixed_frames(count + 100, seed=2) if frame not in set(back)][:count]
    dump = rig.candump(near)
    adapter = Adapter.on_host(rig, "--mixed", "--traffic", 2000, "--count", count, "--seed", SEED)
    bridge = rig.bridge(configuration(port, near))
    bridge.wait_ready(lambda: dump.count, "the first frame")
    assert rig.play(near, there).wait(300) == 0
    assert_same_frames(adapter.wait_recorded(count), there)
    seen = adapter.wait_traffic()
    wait_received(bridge, dump, seen, others=count)
    frames = dump.finish(0)
    sent = set(there)
    assert_same_frames([frame for frame in frames if frame in sent], there)
    assert_received(bridge, [frame for frame in frames if frame not in sent], seen, back)
    assert_sent(bridge, count)
    bridge.stop_cleanly()
    chip.wait_tty()
    adapter.stop_closed()


def assert_carries(rig: Rig, bridge: Bridge, near: str, far: str, count: int) -> None:
    """So many frames each way through an adapter in the guest: slowly, it receives into a small buffer."""
    for source, sink, rate, seed in ((near, far, None, 3), (far, near, 150, 4)):
        arrived, frames = rig.candump(sink), mixed_frames(count, seed)
        player = rig.play(source, frames, rate)
        assert_same_frames(arrived.finish(count, deadline_s=300), frames)
        assert player.wait() == 0
    assert_sent(bridge, count)


def test_two_chips_are_told_apart(rig: Rig) -> None:
    """One bridge at each, the first by libusb and the second by its tty."""
    chips = [rig.chip("ftdi0"), rig.chip("ftdi1")]
    ports = [address(chips[0].serial_number, raw=True), address(chips[1].serial_number, raw=False)]
    nears, far = [rig.vcan(), rig.vcan()], rig.vcan()
    adapters = [Adapter.on_host(rig), Adapter.in_guest(rig, far, chips[1].far_end)]
    bridges = [
        rig.bridge(configuration(*ends), f"bridge{ends[1]}") for ends in zip(ports, nears, strict=True)
    ]
    for bridge, chip in zip(bridges, chips, strict=True):
        status = bridge.wait_state("running")
        assert status["adapter"]["serial_number"] == chip.serial_number
    first = mixed_frames(2000, seed=5)
    player = rig.play(nears[0], first)
    assert_carries(rig, bridges[1], nears[1], far, 500)
    assert player.wait() == 0
    assert_same_frames(adapters[0].wait_recorded(len(first)), first)
    assert_sent(bridges[0], len(first))
    for bridge, chip, adapter in zip(bridges, chips, adapters, strict=True):
        bridge.stop_cleanly()
        chip.wait_tty()
        adapter.stop_closed()


@BOTH_PORTS
def test_chip_that_sends_empty_packets(rig: Rig, raw: bool) -> None:
    near, count = rig.vcan(), 300
    there, back = mixed_frames(count, seed=3), traffic(count)
    with plugged("usb2can", FAKE) as chip:
        bridge = rig.bridge(configuration(address(FAKE, raw=raw), near))
        bridge.wait_state("running")
        player = rig.play(near, there)
        wait_until(lambda: len(chip.life.sent) >= count, "all frames to be on its bus")
        assert player.wait() == 0
        arrived = rig.candump(near)
        chip.hear(itertools.islice(serve.mixed_frames(random.Random(SEED)), count), fps=150)
        assert_same_frames(arrived.finish(count), back)
        assert_same_frames(chip.life.sent, there)
        assert_sent(bridge, count)
        assert chip.idle_packets
        bridge.stop_cleanly()
        wait_terminal(FAKE)


@BOTH_PORTS
def test_a_device_that_stops_reading_in_the_middle_of_a_frame(rig: Rig, raw: bool) -> None:
    """When it reads on, it finds the rest, and no frame with the bytes of a command; also after a stop."""
    near, frames = rig.vcan(), mixed_frames(400, seed=4)
    with plugged("usb2can", FAKE) as chip:
        settings = configuration(address(FAKE, raw=raw), near, deadline=0.5)
        for bytes_read in (23, 150, 401):
            bridge = rig.bridge(settings)
            for _ in range(2):
                bridge.wait_state("running")
                chip.reads(bytes_read)
                assert rig.play(near, frames).wait() == 0
                bridge.wait_state("backoff")
                chip.reads(None)
            bridge.wait_state("running")
            bridge.stop_cleanly()
        with chip.device() as device:
            assert device.violations == []
        assert len(chip.life.sent) > 3
        assert [frame for frame in chip.life.sent if frame not in frames] == []


@BOTH_PORTS
def test_a_device_that_reads_nothing_delays_no_stop(rig: Rig, raw: bool) -> None:
    near = rig.vcan()
    with plugged("usb2can", FAKE) as chip:
        bridge = rig.bridge(configuration(address(FAKE, raw=raw), near))
        bridge.wait_state("running")
        chip.reads(23)
        assert rig.play(near, mixed_frames(400, seed=4)).wait() == 0
        begin = time.monotonic()
        bridge.stop_cleanly()
        assert time.monotonic() - begin < 10.0, "20 times slower than it is"
        chip.reads(None)


def test_listen_only_with_a_filter(rig: Rig) -> None:
    chip, near, far = rig.chip("ftdi1"), rig.vcan(), rig.vcan()
    settings = configuration(address(chip.serial_number, raw=True), near)
    settings["channel"] |= {"listen_only": True, "acceptance": {"code": 0x6000, "mask": 0x1FF0}}
    del settings["transmit"]
    adapter = Adapter.in_guest(rig, far, chip.far_end)
    bridge = rig.bridge(settings)
    bridge.wait_state("running")
    arrived, seen = rig.candump(near), rig.candump(far)
    rig.cansend(near, "345#55")
    bridge.wait_status(lambda s: s["counters"]["tx_dropped"]["listen-only"] == 1, "the frame to be dropped")
    there = ["2FF#01", "300#02", "400#03", "3FF#R4", "7FF#", "355#05060708"]
    for frame in there:
        rig.cansend(far, frame)
    assert arrived.finish(4) == ["345#55", "300#02", "3FF#R4", "355#05060708"]
    assert seen.finish(len(there)) == there
    balanced(bridge.read_status())
    bridge.stop_cleanly()
    chip.wait_tty()
    assert adapter.stop_closed()["counters"]["frames_filtered"] == 3
    assert adapter.recorded == []


@pytest.mark.parametrize(
    ("configured", "there", "reason"),
    [("usb2can", "can232", "is it the USB2CAN"), ("can232", "usb2can", "no answer to V")],
)
def test_wrong_device(rig: Rig, configured: str, there: str, reason: str) -> None:
    near, far = rig.vcan(), rig.vcan()
    _, port = rig.simulate(far, adapter=there)
    settings = configuration(str(port), near)
    settings["adapter"]["type"] = configured
    arrived = rig.candump(far)
    bridge = rig.bridge(settings)
    status = bridge.wait_status(lambda s: reason in s["reason"], "the reason")
    assert status["state"] in {"closing", "rejecting", "backoff", "fault"}
    rig.cansend(near, "123#55")
    bridge.wait_status(lambda s: s["counters"]["tx_dropped"]["adapter-away"] == 1, "the frame to be dropped")
    bridge.stop_cleanly()
    assert arrived.finish(0) == []
