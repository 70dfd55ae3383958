"""A bridge in a container, its application in another, the interface in their own network namespace."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from books import check_books
from containers import INTERFACE_MAKER, UNPRIVILEGED, Container, Containers
from rig import Chip, Process, Rig, assert_same_frames, mixed_frames, receivers, wait_until
from test_can232 import PATIENT, assert_closed
from wired import TRANSPORT_S, in_order

pytestmark = pytest.mark.timeout(900)

NEAR = "vcan0"
USER = 65532
DIALOUT = "20"
FRAMES = 1000
STOP_MAX_S = 2.0
DEADLINE = 0.5  # seconds, for frames that are on their way when a bridge is killed
MANIFEST = Path("/repo/config/container/podman.yaml")


def configuration(port: str | Path, **sections: Any) -> dict[str, Any]:
    """Of a bridge in a container."""
    return {
        "adapter": {"type": "can232", "port": str(port), "baudrate": 115200},
        "channel": {"bitrate": 1_000_000},
        "bus": {"channel": NEAR},
    } | sections


def has_interface(name: str) -> bool:
    """Whether this machine's own namespace sees it."""
    return Path("/sys/class/net", name).exists()


class Adapter:
    """A simulated CAN232 behind this machine's USB chip; its CAN bus is the interface `far`."""

    def __init__(self, rig: Rig) -> None:
        self.chip: Chip = rig.chip("ftdi1")
        self.far = rig.vcan()
        self._state = rig.directory / "state.json"
        line = ("--line", self.chip.far_end, "--bus", self.far, "--state", self._state)
        self._process: Process = rig.start(*rig.command, "simulate", "can232", *line)
        self._process.wait_ready(lambda: receivers(self.far), "the simulated adapter to listen")
        keep_on_a_processor(self._process.pid)

    @property
    def options(self) -> tuple[str, ...]:
        """For the container that has it: the device, and the group of ttys."""
        return "--device", str(self.chip.tty), "--group-add", DIALOUT

    def assert_closed(self) -> None:
        """The bridge has closed its channel."""
        assert self._process.stop() == 0, str(self._process)
        assert_closed(self._state)


def read_status(bridge: Container) -> dict[str, Any]:
    """Of a bridge, with the books checked."""
    status: dict[str, Any] = json.loads(bridge.execute("can-bridge", "status", "--json"))
    check_books(status["counters"], status["queued"])
    return status


def keep_on_a_processor(pid: int) -> None:
    """A process, all its threads. On a loaded machine a vcan may swap two frames of a sender that is moved to
    another processor between them: what this machine's emulation does all the time."""
    for thread in Path("/proc", str(pid), "task").iterdir():
        os.sched_setaffinity(int(thread.name), {min(os.sched_getaffinity(0))})


def assert_stops(bridge: Container) -> None:
    """SIGTERM ends it within 2 s, with exit status 0. (podman itself takes a second here.)"""
    pid = bridge.pid
    begin = time.monotonic()
    os.kill(pid, signal.SIGTERM)
    wait_until(lambda: not Path("/proc", str(pid)).exists(), f"the end of {bridge}")
    took = time.monotonic() - begin
    assert took <= STOP_MAX_S
    assert bridge.exit_status() == 0


def assert_without_privilege(bridge: Container) -> None:
    lines = Path("/proc", str(bridge.pid), "status").read_text().splitlines()
    status = {name: value.split() for name, _, value in (line.partition(":") for line in lines)}
    assert status["Uid"] == [str(USER)] * 4
    assert {int(status[kind][0], 16) for kind in ("CapInh", "CapPrm", "CapEff", "CapAmb")} == {0}


def test_started_without_its_adapter(containers: Containers) -> None:
    pod = containers.pod()
    containers.once("--pod", pod, *INTERFACE_MAKER, "can-bridge", "interface", NEAR)
    assert not has_interface(NEAR)
    settings = containers.configuration(configuration("/dev/ttyUSB9"))
    bridge = containers.start("--pod", pod, *UNPRIVILEGED, *settings, "can-bridge")
    bridge.wait_log("state=waiting")
    bridge.wait_check("started")
    assert_stops(bridge)


@pytest.mark.parametrize("levels", [1, 2])
@pytest.mark.parametrize("count", [FRAMES, pytest.param(5 * FRAMES, marks=pytest.mark.long)])
def test_frames_each_way_arrive_exactly(rig: Rig, containers: Containers, levels: int, count: int) -> None:
    """Two levels: another container makes the interface. One: the bridge begins as root, becomes a user."""
    adapter = Adapter(rig)
    pod = containers.pod()
    bus = {"channel": NEAR, "create": levels == 1}
    options = [*containers.configuration(configuration(adapter.chip.wait_tty(), bus=bus, transmit=PATIENT))]
    command: list[str] = []
    if levels == 2:
        containers.once("--pod", pod, *INTERFACE_MAKER, "can-bridge", "interface", NEAR)
        options += UNPRIVILEGED
    else:
        options += [*INTERFACE_MAKER, "--cap-add", "SETUID", "--cap-add", "SETGID"]
        command = ["run", "--user", str(USER), "/etc/can-bridge/can-bridge.yaml"]
    bridge = containers.start("--pod", pod, *options, *adapter.options, "can-bridge", *command)
    bridge.wait_check("ready")
    assert_without_privilege(bridge)
    assert not has_interface(NEAR)
    keep_on_a_processor(bridge.pid)

    application = containers.application(pod)
    frames = mixed_frames(count, seed=levels)
    near, far = rig.candump(NEAR, place=application), rig.candump(adapter.far)
    assert rig.play(NEAR, frames, place=application).wait(300) == 0
    assert_same_frames(far.finish(count, deadline_s=300), frames)
    # The adapter's FIFO holds 32 frames: the emulated machine may stand still for 0.2 s.
    assert rig.play(adapter.far, frames, rate=150).wait(300) == 0
    assert_same_frames(near.finish(2 * count, deadline_s=300), frames + frames)
    counters = read_status(bridge)["counters"]
    assert (counters["tx_frames"], counters["rx_frames"], counters["rx_errors"]) == (count, count, 0)
    assert_stops(bridge)
    adapter.assert_closed()


def test_application_outlives_its_bridge(rig: Rig, containers: Containers) -> None:
    """The bridge is killed amid traffic and started again; who listens on the interface does not notice."""
    adapter = Adapter(rig)
    pod = containers.pod()
    containers.once("--pod", pod, *INTERFACE_MAKER, "can-bridge", "interface", NEAR)
    settings = configuration(adapter.chip.wait_tty(), transmit={"deadline": DEADLINE})
    bridge = containers.start(
        "--pod", pod, "--restart", "on-failure", *UNPRIVILEGED, *containers.configuration(settings),
        *adapter.options, "can-bridge",
    )  # fmt: skip
    bridge.wait_check("ready")
    application = containers.application(pod)
    near, far = rig.candump(NEAR, place=application), rig.candump(adapter.far)
    numbered = ("-L", "8", "-D", "i")
    senders = [
        rig.cangen(NEAR, 1_000_000, "-I", "100", *numbered, gap_ms=20, place=application),
        rig.cangen(adapter.far, 1_000_000, "-I", "200", *numbered, gap_ms=20),
    ]
    pauses = []
    for _ in range(2):
        count = near.count
        wait_until(lambda n=count: near.count > n + 200, "traffic")  # type: ignore[misc]
        pid = bridge.pid
        begin = time.time()
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda p=pid: bridge.pid not in {0, p}, "the bridge to be started again")  # type: ignore[misc]
        bridge.wait_check("ready")
        pauses.append((begin, time.time()))
    count = near.count
    wait_until(lambda: near.count > count + 200, "traffic")
    assert near.status is None
    for sender in senders:
        sender.stop()
    wait_until(lambda: read_status(bridge)["queued"] == 0, "an empty queue")
    assert_stops(bridge)
    near.stop()
    far.stop()

    for identifier, source, sink in (("100", near, far), ("200", far, near)):
        sent = [(at, frame) for at, frame in source.stamped if frame.startswith(f"{identifier}#")]
        arrived = {frame: at for at, frame in sink.stamped if frame.startswith(f"{identifier}#")}
        assert in_order(arrived, (frame for _, frame in sent))
        assert len(arrived) == sum(frame.startswith(f"{identifier}#") for frame in sink.frames)  # none twice
        # Lost is what was on its way when the bridge died, and what came while there was none, nothing else.
        on_its_way_s = DEADLINE + TRANSPORT_S
        lost = [at for at, frame in sent if frame not in arrived]
        others = [
            at for at in lost if not any(since - on_its_way_s <= at <= until for since, until in pauses)
        ]
        assert others == [], (
            f"{identifier}: {len(lost)} lost, of {sent[0][0]} to {sent[-1][0]}; pauses {pauses}"
        )
        late = [arrived[frame] - at for at, frame in sent if frame in arrived]
        assert max(late) <= on_its_way_s


# A serial server: one client at a time has the terminal argv[1] at port argv[2].
SERVER = """
import os, select, socket, sys, tty
line = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
tty.setraw(line)
server = socket.create_server(("127.0.0.1", int(sys.argv[2])))
while True:
    client, _ = server.accept()
    with client:
        while True:
            ready = select.select([client, line], [], [])[0]
            if line in ready:
                client.sendall(os.read(line, 4096))
            if client in ready:
                data = client.recv(4096)
                if not data:
                    break
                while data:
                    data = data[os.write(line, data):]
"""


def test_manifest_for_podman(rig: Rig, containers: Containers) -> None:
    """As it is, but for the address of the serial server: no other machine is here."""
    far = rig.vcan()
    _, link = rig.simulate(far)
    text = MANIFEST.read_text()
    name = next(one["metadata"]["name"] for one in yaml.safe_load_all(text) if one["kind"] == "Pod")
    manifest = rig.directory / "podman.yaml"
    manifest.write_text(text.replace("192.168.1.50:4001", "127.0.0.1:4001"))
    containers.play(manifest, name)
    application, bridge = Container(f"{name}-application"), Container(f"{name}-bridge")
    assert not has_interface(NEAR)
    bridge.wait_check("started")
    place = containers.application(name)
    assert place.process
    rig.start("nsenter", "--net", "--target", str(place.process), "python3", "-c", SERVER, link, "4001")
    bridge.wait_check("ready")
    assert_without_privilege(bridge)
    rig.cansend(far, "123#1122")
    application.wait_log("123   [2]  11 22")
    dump = rig.candump(far)
    subprocess.run([*place.prefix, "cansend", NEAR, "1ABCDEF0#33"], check=True)
    assert dump.finish(1) == ["1ABCDEF0#33"]
