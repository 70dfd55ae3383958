"""The interface made by one process and the bridge run by another without privileges; or one gives them up.

The capability is in the bounding set only, as Docker and containerd give it: root has it then, no other user.
"""

import os
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from rig import DEADLINE_S, Rig, assert_same_frames, mixed_frames, wait_until

USER = 65532
NAMES = ("--reuid", str(USER), "--regid", str(USER), "--clear-groups")
IN_TURN = 200


def limited(*capabilities: str) -> list[str]:
    """Begin as Docker has root begin that was given these."""
    kept = "".join(f",+{name}" for name in capabilities)
    return ["setpriv", f"--bounding-set=-all{kept}", "--inh-caps=-all", "--ambient-caps=-all"]


@pytest.fixture(autouse=True)
def as_root() -> None:
    if os.geteuid() != 0:
        pytest.skip("takes root")


@pytest.fixture
def run() -> Iterator[Path]:
    """XDG_RUNTIME_DIR of the image, of its user."""
    with tempfile.TemporaryDirectory(dir="/run") as folder:
        os.chown(folder, USER, USER)
        Path(folder).chmod(0o755)  # root of the container may not override it
        yield Path(folder)


@pytest.fixture
def interface() -> Iterator[str]:
    """A name for one; it is deleted afterwards."""
    name = "cbpriv0"
    yield name
    subprocess.run(["ip", "link", "delete", name], check=False, capture_output=True)


def execute(*arguments: str | Path, run: Path, status: int = 0) -> str:
    done = subprocess.run(
        arguments,
        env=os.environ | {"XDG_RUNTIME_DIR": str(run)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == status, (arguments, done.returncode, done.stdout)
    return done.stdout


def test_an_interface_takes_one_capability(rig: Rig, run: Path, interface: str) -> None:
    """Made, brought up, found up; another user with the same bounding set is told what to do."""
    command = [*rig.command, "interface", interface]
    refused = execute(*limited("net_admin"), *NAMES, *command, run=run, status=1)
    assert "creating it needs CAP_NET_ADMIN" in refused
    assert "in a container as uid 0 with --cap-add NET_ADMIN" in refused
    said = [execute(*limited("net_admin"), *command, run=run) for _ in range(2)]
    assert said == [f"{interface}: is up\n", f"{interface}: was up before\n"]
    subprocess.run(["ip", "link", "set", interface, "down"], check=True)
    assert execute(*limited("net_admin"), *command, run=run) == f"{interface}: is up\n"
    assert "UP" in subprocess.check_output(["ip", "-o", "link", "show", interface], text=True)
    assert "not a CAN interface" in execute(
        *limited("net_admin"), *rig.command, "interface", "lo", run=run, status=1
    )


@pytest.mark.parametrize("levels", [1, 2])
def test_levels_of_privilege(rig: Rig, run: Path, interface: str, levels: int) -> None:
    """The bridge relays as another user, without a capability; root of its container asks how it is."""
    far = rig.vcan()
    _, port = rig.simulate(far, "--uart-rate", "115200")
    os.chown(port, USER, USER)
    file = run / "can-bridge.yaml"
    file.write_text(
        yaml.safe_dump(
            {
                "adapter": {"type": "can232", "port": str(port.resolve()), "baudrate": 115200},
                "channel": {"bitrate": 125000},
                "bus": {"channel": interface, "create": True},
                "transmit": {"deadline": 30.0},
            }
        )
    )
    if levels == 2:
        execute(*limited("net_admin"), *rig.command, "interface", file, run=run)
        inside, user = [*limited(), *NAMES], []
    else:
        inside, user = limited("net_admin", "setuid", "setgid"), ["--user", str(USER)]
    bridge = rig.start("env", f"XDG_RUNTIME_DIR={run}", *inside, *rig.command, "run", *user, file)
    wait_until((run / "can-bridge/can-bridge.sock").exists, "the status socket")
    status = Path(f"/proc/{bridge.pid}/status").read_text()
    assert f"Uid:\t{USER}\t{USER}\t{USER}\t{USER}\n" in status
    for kind in ("Inh", "Prm", "Eff", "Amb"):
        assert f"Cap{kind}:\t0000000000000000" in status

    def probe(word: str, exit_status: int = 0) -> str:
        return execute(*inside, *rig.command, "status", "--check", word, run=run, status=exit_status)

    wait_until(lambda: "state=running" in bridge.err, "the bridge to run")
    assert [probe(word) for word in ("started", "ready", "live")] == [
        f"can-bridge: {word}, running\n" for word in ("started", "ready", "live")
    ]
    frames = mixed_frames(IN_TURN)
    for source, drain in ((far, interface), (interface, far)):
        dump = rig.candump(drain)
        rig.play(source, frames, rate=400)
        assert_same_frames(dump.finish(len(frames)), frames)
    subprocess.run(["ip", "link", "set", interface, "down"], check=True)
    assert "is down" in probe("started", 1)
    assert bridge.stop() == 0
