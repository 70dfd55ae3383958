"""CAN232 to SocketCAN and back with real can-utils on a real kernel: nothing is lost, or it is counted."""

import json
import random
import signal
import socket
import subprocess
from pathlib import Path
from typing import Any

import pytest
from books import check_books
from rig import DEADLINE_S, Bridge, Rig, assert_same_frames, mixed_frames, receivers, wait_until

pytestmark = pytest.mark.timeout(900)

FRAMES = 5000, pytest.param(20_000, marks=pytest.mark.long)
# Nothing grows stale where an emulated machine takes its time.
PATIENT = {"queue": 65536, "deadline": 600.0}


def configuration(port: Path, bus: str, **transmit: Any) -> dict[str, Any]:
    return {
        "adapter": {"type": "can232", "port": str(port), "baudrate": 115200},
        "channel": {"bitrate": 1_000_000},
        "bus": {"channel": bus},
        "transmit": PATIENT | transmit,
    }


def taken_for_can232(port: Path, bus: str, **transmit: Any) -> dict[str, Any]:
    """slcanpty would be recognised as no CAN232; and the long flush overflows buffers, as it is meant to."""
    settings = configuration(port, bus, **transmit)
    settings["adapter"]["firmware"] = "can232"
    return settings


def balanced(status: dict[str, Any]) -> dict[str, Any]:
    """The counters, with the books checked: every frame that was read went somewhere."""
    counters: dict[str, Any] = status["counters"]
    check_books(counters, status["queued"])
    return counters


def generate(rig: Rig, interface: str, frames: int, *, gap_ms: float, remote_dlc: str = "r") -> None:
    """So many frames of cangen with all DLCs: standard, extended, remote, both, one kind after the other."""
    for options, share, dlc in (
        ((), 0.4, "r"),
        (("-e",), 0.4, "r"),
        (("-R",), 0.1, remote_dlc),
        (("-R", "-e"), 0.1, remote_dlc),
    ):
        modes = ("-I", "r", "-L", dlc, "-D", "r")
        process = rig.cangen(interface, round(frames * share), *modes, *options, gap_ms=gap_ms)
        assert process.wait(900) == 0, str(process)


def assert_carries(
    rig: Rig, bridge: Bridge, near: str, far: str, count: int, *, gap_ms: float, remote_dlc: str = "r"
) -> None:
    """`count` frames of cangen in each direction; candump's logs of both interfaces are the same.

    There as fast as cangen goes: they queue in the bridge. Back with a gap, for the adapter's small FIFO.
    """
    before = balanced(bridge.read_status())
    for source, sink, gap, dlc in ((near, far, 0, remote_dlc), (far, near, gap_ms, "r")):
        sent, arrived = rig.candump(source), rig.candump(sink)
        generate(rig, source, count, gap_ms=gap, remote_dlc=dlc)
        frames = sent.finish(count)
        assert len(frames) == count
        assert_same_frames(arrived.finish(count, deadline_s=600), frames)
    after = balanced(bridge.read_status())
    gained = {key: after[key] - before[key] for key in ("tx_frames", "rx_frames", "rx_errors")}
    assert gained == {"tx_frames": count, "rx_frames": count, "rx_errors": 0}


def assert_closed(state: Path) -> dict[str, Any]:
    """The simulator's state after the bridge has ended: the channel is closed."""
    seen: dict[str, Any] = json.loads(state.read_text())
    assert seen["channel"] in {"closed", "uninitiated"}
    return seen


@pytest.mark.parametrize("count", FRAMES)
def test_cangen_each_way_arrives_exactly(rig: Rig, count: int) -> None:
    near, far = rig.vcan(), rig.vcan()
    state = rig.directory / "state.json"
    simulator, port = rig.simulate(far, "--state", state)
    bridge = rig.bridge(taken_for_can232(port, near))
    assert bridge.wait_state("running")["adapter"]["serial_number"] == "A123"
    assert_carries(rig, bridge, near, far, count, gap_ms=2)
    bridge.stop_cleanly()
    assert simulator.stop() == 0
    seen = assert_closed(state)
    assert (seen["counters"]["rs232_lost"], seen["counters"]["frames_lost"]) == (0, 0)


def test_both_ways_at_once_and_with_a_window_of_two(rig: Rig) -> None:
    near, far = rig.vcan(), rig.vcan()
    _, port = rig.simulate(far)
    bridge = rig.bridge(configuration(port, near, window=2))
    bridge.wait_state("running")
    there = [f for f in mixed_frames(6000, seed=1) if f[2] in "02468ACE"][:2000]
    back = [f for f in mixed_frames(6000, seed=2) if f[2] in "13579BDF"][:2000]
    dumps = rig.candump(near), rig.candump(far)
    players = rig.play(near, there, rate=150), rig.play(far, back, rate=150)
    for player in players:
        assert player.wait(300) == 0
    for dump in dumps:
        frames = dump.finish(4000, deadline_s=120)
        assert_same_frames([f for f in frames if f[2] in "02468ACE"], there)
        assert_same_frames([f for f in frames if f[2] in "13579BDF"], back)
    balanced(bridge.read_status())
    bridge.stop_cleanly()


@pytest.mark.parametrize("count", FRAMES)
def test_slcanpty_as_the_adapter(rig: Rig, count: int) -> None:
    near, far = rig.vcan(), rig.vcan()
    _, port = rig.slcanpty(far)
    bridge = rig.bridge(taken_for_can232(port, near))
    assert bridge.wait_state("running")["adapter"]["version"] == "V1013"
    # It takes a remote frame's DLC for the next command: refuses that, and sends the frame with DLC 0.
    assert_carries(rig, bridge, near, far, count, gap_ms=1, remote_dlc="0")
    bridge.stop_cleanly()


@pytest.mark.parametrize("there", [True, False])
def test_cansequence(rig: Rig, there: bool) -> None:
    near, far = rig.vcan(), rig.vcan()
    _, port = rig.slcanpty(far)
    bridge = rig.bridge(taken_for_can232(port, near))
    bridge.wait_state("running")
    source, sink = (near, far) if there else (far, near)
    receiver = rig.start("stdbuf", "-oL", "cansequence", sink, "-r", "-q", "1", "-v")
    dump = rig.candump(sink)
    wait_until(lambda: receivers(sink) >= 3, "cansequence to listen")
    for turn in range(1, 21):  # as many at a time as slcanpty's receive buffer holds; numbers go round at 256
        done = subprocess.run(["cansequence", source, "-p", "--loop=256"], check=False, timeout=DEADLINE_S)
        assert done.returncode == 0
        wait_until(lambda n=256 * turn: dump.count >= n, "the frames of one round")  # type: ignore[misc]
    assert dump.finish(20 * 256) == [f"002#{n % 256:02X}" for n in range(20 * 256)]
    assert receiver.status is None, f"a wrong sequence number: {receiver}"
    bridge.stop_cleanly()


def test_flood_far_above_line_rate_is_accounted_to_the_frame(rig: Rig) -> None:
    """cangen as fast as it goes against 115200 Bd: the adapter's small RS232 buffer never overflows."""
    near, far = rig.vcan(), rig.vcan()
    state = rig.directory / "state.json"
    simulator, port = rig.simulate(far, "--uart-rate", "115200", "--state", state)
    bridge = rig.bridge(taken_for_can232(port, near, queue=1024, deadline=1.0))
    bridge.wait_state("running")
    arrived = rig.candump(far)
    generated = 50_000
    assert rig.cangen(near, generated, "-I", "i", "-L", "8", "-D", "i").wait(300) == 0
    bridge.wait_status(lambda status: status["queued"] == 0, "an empty queue")
    status = bridge.read_status()
    counters = balanced(status)
    assert counters["tx_frames"] + status["queued"] + sum(counters["tx_dropped"].values()) == generated
    assert counters["tx_dropped"]["unanswered"] == counters["rx_errors"] == 0
    frames = arrived.finish(counters["tx_frames"])
    numbers = [int.from_bytes(bytes.fromhex(frame.split("#")[1]), "little") for frame in frames]
    assert len(numbers) == counters["tx_frames"]
    assert numbers == sorted(set(numbers))  # in order, none twice
    bridge.stop_cleanly()
    assert simulator.stop() == 0
    assert assert_closed(state)["counters"]["rs232_lost"] == 0


def test_starts_and_stops_at_any_moment_leave_it_closed_and_its_eeprom_alone(rig: Rig) -> None:
    near, far = rig.vcan(), rig.vcan()
    state = rig.directory / "state.json"
    simulator, port = rig.simulate(far, "--state", state, "--uart-rate", "9600")
    settings = configuration(port, near) | {"channel": {"bitrate": 125000}}
    settings["channel"]["acceptance"] = {"code": 0x6000, "mask": 0x1FF0}
    draw = random.Random(3)
    for n in range(8):
        bridge = rig.bridge(settings, name=f"start{n}")
        if n % 2:
            bridge.wait_state("running")
        else:  # somewhere in the initialisation, which takes a while at 9600 Bd
            bridge.wait_ready(lambda b=bridge: "state=initialising" in b.err, "the initialisation")  # type: ignore[misc]
            draw.random()
        assert bridge.stop(draw.choice([signal.SIGTERM, signal.SIGINT])) == 0
        state.unlink(missing_ok=True)
        simulator._popen.send_signal(signal.SIGUSR1)
        wait_until(state.exists, "the simulator's state")
        assert assert_closed(state)["eeprom"]["writes"] <= 1


def test_error_and_fd_frames_are_counted_not_forwarded_and_own_frames_not_echoed(rig: Rig) -> None:
    near, far = rig.vcan(), rig.vcan()
    subprocess.run(["ip", "link", "set", near, "down"], check=True)
    subprocess.run(["ip", "link", "set", near, "mtu", "72"], check=True)
    subprocess.run(["ip", "link", "set", near, "up"], check=True)
    _, port = rig.simulate(far)
    bridge = rig.bridge(configuration(port, near))
    bridge.wait_state("running")
    arrived, seen = rig.candump(far), rig.candump(near)
    rig.cansend(near, "123##1112233")
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind((near,))
        raw.send((0x20000004).to_bytes(4, "little") + bytes([8, 0, 0, 0]) + bytes(8))
    rig.cansend(near, "321#55")
    rig.cansend(far, "456#66")
    assert arrived.finish(2) == ["321#55", "456#66"]
    assert seen.finish(3)[-2:] == ["321#55", "456#66"]
    counters = balanced(bridge.read_status())
    assert (counters["tx_dropped"]["fd-frame"], counters["tx_dropped"]["error-frame"]) == (1, 1)
    assert (counters["tx_frames"], counters["rx_frames"]) == (1, 1)
    bridge.stop_cleanly()


def test_frames_for_an_interface_that_is_down_are_counted(rig: Rig) -> None:
    near, far = rig.vcan(), rig.vcan()
    _, port = rig.simulate(far)
    bridge = rig.bridge(configuration(port, near))
    bridge.wait_state("running")
    subprocess.run(["ip", "link", "set", near, "down"], check=True)
    rig.cansend(far, "456#66")
    bridge.wait_status(lambda s: s["counters"]["rx_dropped"]["bus-down"] == 1, "the frame to be counted")
    subprocess.run(["ip", "link", "set", near, "up"], check=True)
    dump = rig.candump(near)
    rig.cansend(far, "457#66")
    assert dump.finish(1) == ["457#66"]
    assert "is down" in bridge.err
    bridge.stop_cleanly()


def test_a_missing_interface_is_created_and_a_second_bridge_refused(rig: Rig) -> None:
    far, name = rig.vcan(), "cbtmade"
    _, port = rig.simulate(far)
    settings = configuration(port, name)
    settings["bus"]["create"] = True
    bridge = rig.bridge(settings)
    try:
        bridge.wait_state("running")
        second = rig.bridge(settings)
        assert second.wait() == 1
        assert "is running already" in second.err
        dump = rig.candump(name)
        rig.cansend(far, "001#")
        assert dump.finish(1) == ["001#"]
        bridge.stop_cleanly()
    finally:
        subprocess.run(["ip", "link", "delete", name], check=False)


def test_commands_say_what_is_wrong(rig: Rig) -> None:
    def command(*arguments: str) -> tuple[int, str]:
        done = subprocess.run(
            [*rig.command, *arguments], check=False, capture_output=True, text=True, timeout=120
        )
        return done.returncode, done.stdout + done.stderr

    file = rig.directory / "bad.yaml"
    file.write_text(
        "adapter: {type: can232, port: /dev/ttyUSB0}\nchannel: {bitrat: 125000}\nbus: {channel: vcan0}\n"
    )
    status, text = command("check", str(file))
    assert status == 78
    assert f"{file}:2:11: channel.bitrat:" in text
    assert command("run", str(file))[0] == 78
    assert command("status", "--socket", str(rig.directory / "none.sock"))[0] == 3


def test_demo_shows_frames_both_ways(rig: Rig) -> None:
    existed = Path("/sys/class/net/vcan0").exists()
    demo = rig.start(*rig.command, "demo", "--duration", "15")
    assert demo.wait(180) == 0, str(demo)
    assert "from the adapter" in demo.out
    assert "to the adapter" in demo.out
    assert "Its channel is closed." in demo.out
    if not existed:
        subprocess.run(["ip", "link", "delete", "vcan0"], check=True)
