"""The container images, built without a Docker engine (image.sh), and podman to start them with."""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]
# As a careful administrator starts it. Health checks by podman need systemd, which a build machine may lack.
UNPRIVILEGED = ["--no-healthcheck", "--network", "none", "--read-only", "--cap-drop", "ALL",
                "--security-opt", "no-new-privileges"]  # fmt: skip


class Image:
    """localhost/can-bridge, as it was built last."""

    def __init__(self) -> None:
        self.directory = Path(self._script("--where"))
        self.name = f"localhost/can-bridge:{self._script('--tag')}"

    @staticmethod
    def _script(*arguments: str, errors: int | None = None) -> str:
        return subprocess.run(
            ["sh", HERE / "image.sh", *arguments],
            check=True,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        ).stdout.strip()

    def podman(self, *arguments: str) -> str:
        return self._script("--podman", *arguments)

    def logs(self, container: str) -> str:
        return self._script("--podman", "logs", container, errors=subprocess.STDOUT)

    def inspect(self) -> dict[str, Any]:
        (found,) = json.loads(self.podman("image", "inspect", self.name))
        return dict(found)

    def run(self, *command: str) -> str:
        """The output of another command than can-bridge in it."""
        return self.podman("run", "--rm", *UNPRIVILEGED, "--entrypoint", command[0], self.name, *command[1:])


@pytest.fixture(scope="session")
def image() -> Image:
    subprocess.run(["sh", HERE / "image.sh"], check=True)
    return Image()
