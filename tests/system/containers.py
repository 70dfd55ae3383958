"""Containers on a real kernel: podman in the virtual machine, with the images of tests/container/image.sh.

The images are on a disk of their own, which podman reads as an additional store: nothing is unpacked. What
containers write is in memory. `./dev test system` builds the images and gives the machine the disk where all
tests or something with "container" in its name is asked for (-k container), `./dev vm run` where the images
of the present sources are built already (`./dev image`). The fixture `containers` makes and clears them:

    def test_started_without_its_adapter(containers):
        pod = containers.pod()                                     # a network namespace of its own
        containers.once("--pod", pod, *INTERFACE_MAKER, "can-bridge", "interface", "vcan0")
        bridge = containers.start(
            "--pod", pod, *UNPRIVILEGED, *containers.configuration({"adapter": …}), "can-bridge"
        )
        bridge.wait_check("started")
        assert bridge.stop() == 0

Options and commands are podman's. A container of can-bridge takes some 5 s to start in this slow machine.
"""

import itertools
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from rig import DEADLINE_S, MONITOR, Place, wait_until

DISK = Path("/dev/vdb")
IMAGES = Path("/run/container-images")
STORE = Path("/run/containers-of-tests")
STORE_SIZE = "300m"
STORAGE = f"""
[storage]
driver = "overlay"
runroot = "{STORE}/run"
graphroot = "{STORE}/store"
[storage.options]
additionalimagestores = ["{IMAGES}"]
"""
# Health checks are systemd timers here: each would take a second of this machine's time every five.
QUIET = ("--no-healthcheck",)
UNPRIVILEGED = (*QUIET, "--read-only", "--cap-drop", "ALL", "--security-opt", "no-new-privileges")
# Root with one of its capabilities, the one to make an interface; not ambient, as with Docker.
INTERFACE_MAKER = (*UNPRIVILEGED, "--user", "0:0", "--cap-add", "NET_ADMIN")


def podman(*arguments: str | Path, check: bool = True, errors: int = subprocess.STDOUT) -> str:
    """Its output, both streams unless `errors` is subprocess.PIPE; fails if it does."""
    done = subprocess.run(
        ["podman", *map(str, arguments)],
        check=False, stdout=subprocess.PIPE, stderr=errors, text=True, timeout=2 * DEADLINE_S,
    )  # fmt: skip
    said = f"{done.stdout[-3000:]}{done.stderr or ''}"
    assert not check or done.returncode == 0, f"podman {arguments}: {done.returncode}: {said}"
    return done.stdout.strip()


def prepare() -> None:
    """Once for each boot: the images' disk, and a place in memory for what containers write."""
    if not MONITOR.exists():
        pytest.skip("needs podman and the images of our virtual machine: ./dev test system -k container")
    if not DISK.exists():
        pytest.fail("the machine has no disk with images: ./dev test system -k container", pytrace=False)
    if IMAGES.exists():
        return
    for directory in (IMAGES, STORE):
        directory.mkdir()
    subprocess.run(["mount", "-o", "ro", DISK, IMAGES], check=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={STORE_SIZE}", "containers", STORE], check=True)
    Path("/etc/containers/storage.conf").write_text(STORAGE)


class Container:
    """One that runs beside the test, or has ended."""

    def __init__(self, identity: str) -> None:
        self.identity = identity

    @property
    def logs(self) -> str:
        return podman("logs", self.identity)

    def _state(self, field: str) -> str:
        return podman("inspect", "--format", f"{{{{.State.{field}}}}}", self.identity)

    @property
    def is_running(self) -> bool:
        return self._state("Status") == "running"

    @property
    def pid(self) -> int:
        """Its first process, as this machine numbers it; 0 if it has ended."""
        return int(self._state("Pid"))

    def execute(self, *command: str) -> str:
        """Another program in it, which must succeed; its standard output, without complaints of podman."""
        return podman("exec", self.identity, *command, errors=subprocess.PIPE)

    def wait_log(self, text: str, deadline_s: float = DEADLINE_S) -> None:
        wait_until(lambda: text in self.logs, f"{text!r} in {self}", deadline_s)

    def wait_check(self, probe: str, deadline_s: float = DEADLINE_S) -> None:
        """Until `can-bridge status --check` in it says yes."""
        asked = ("exec", self.identity, "can-bridge", "status", "--check", probe)
        wait_until(lambda: f": {probe}, " in podman(*asked, check=False), f"{probe} of {self}", deadline_s)

    def exit_status(self) -> int:
        """Once it has ended."""
        wait_until(lambda: not self.is_running, f"the end of {self}")
        return int(self._state("ExitCode"))

    def stop(self) -> int:
        """SIGTERM, and after 10 s SIGKILL; the exit status."""
        podman("stop", "--time", "10", self.identity)
        return self.exit_status()

    def __str__(self) -> str:
        return f"container {self.identity[:12]}:\n{self.logs[-3000:]}"


class Containers:
    """Makes the containers of one test, and clears them away afterwards."""

    _numbers = itertools.count(1)

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        for path in (directory, *directory.parents[:2]):  # pytest's are for root only
            path.chmod(0o755)
        self._pods: list[str] = []
        self._made: list[Container] = []

    def pod(self) -> str:
        """A new pod with a network namespace of its own, where only loopback is; its name."""
        name = f"pod{next(self._numbers)}"
        podman("pod", "create", "--network", "none", "--name", name)
        self._pods.append(name)
        return name

    def configuration(self, settings: dict[str, Any]) -> Sequence[str]:
        """The options for a container to have this configuration at the usual place."""
        directory = self.directory / f"etc{next(self._numbers)}"
        directory.mkdir()
        (directory / "can-bridge.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))
        return "--volume", f"{directory}:/etc/can-bridge:ro"

    def application(self, pod: str) -> Place:
        """For can-utils: each command in a container of its own, in this pod."""
        infrastructure = podman("pod", "inspect", "--format", "{{.InfraContainerID}}", pod)
        here = ("--volume", f"{self.directory}:{self.directory}:ro")  # canplayer's file
        return Place(
            ("podman", "run", "--rm", "--pod", pod, *UNPRIVILEGED, *here, "can-utils"),
            Container(infrastructure).pid,
        )

    def start(self, *arguments: str | Path) -> Container:
        """`podman run -d`: options, image, command."""
        container = Container(podman("run", "--detach", *arguments).splitlines()[-1])
        self._made.append(container)
        return container

    def play(self, manifest: Path, pod: str) -> None:
        """`podman play kube` without any network; `pod` is the name of the pod in it."""
        self._pods.append(pod)
        podman("play", "kube", "--network", "none", manifest)

    def once(self, *arguments: str | Path) -> str:
        """`podman run --rm`, which must succeed: options, image, command; its output."""
        return podman("run", "--rm", *arguments)

    def clear(self) -> None:
        """End and remove everything; print the logs, which pytest shows if the test has failed."""
        for container in self._made:
            print(container)
            podman("rm", "--force", "--volumes", "--time", "0", container.identity)
        for pod in self._pods:
            podman("pod", "rm", "--force", "--ignore", pod)
