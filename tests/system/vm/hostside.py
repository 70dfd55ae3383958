"""On the host beside the virtual machine: runs the simulators that the guest asks for. hostside.py DIRECTORY

A simulated adapter must keep up with a real one; in the emulated machine it cannot. DIRECTORY is shared:

    N.argv          one argument per line, complete as soon as it has this name: simulate, usb2can, --line, …
    N.pid           it runs; what it writes is in N.out and N.err
    N.stop, N.usr1  renamed to that by the guest: end it (SIGTERM); tell it SIGUSR1, and N.usr1 is removed
    N.status        its exit status, once it has ended

Nothing but `can-bridge simulate` is ever started. All end with us: at SIGTERM, and when our parent is gone.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

REPOSITORY: Final = Path(__file__).resolve().parents[3]
POLL_INTERVAL_S: Final = 0.05
END_LIMIT_S: Final = 5.0


class HostSide:
    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._seen: set[str] = set()
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._asked_to_end: set[str] = set()

    def _file(self, name: str, suffix: str) -> Path:
        return self._directory / f"{name}.{suffix}"

    def _put(self, name: str, suffix: str, value: int) -> None:
        """Whole or not at all."""
        draft = self._file(name, f"{suffix}-new")
        draft.write_text(f"{value}\n")
        draft.rename(self._file(name, suffix))

    def step(self) -> None:
        for request in sorted(self._directory.glob("*.argv")):
            if request.stem not in self._seen:
                self._seen.add(request.stem)
                self._start(request.stem, request.read_text().splitlines())
        for name, process in list(self._running.items()):
            status = process.poll()
            if status is not None:
                del self._running[name]
                self._put(name, "status", status)
                continue
            if self._file(name, "usr1").exists():
                self._file(name, "usr1").unlink()
                process.send_signal(signal.SIGUSR1)
            if name not in self._asked_to_end and self._file(name, "stop").exists():
                self._asked_to_end.add(name)
                process.terminate()

    def _start(self, name: str, arguments: list[str]) -> None:
        if arguments[:1] != ["simulate"]:
            self._file(name, "err").write_text(f"not a simulator: {arguments}\n")
            self._put(name, "status", 2)
            return
        with self._file(name, "out").open("wb") as out, self._file(name, "err").open("wb") as err:
            self._running[name] = subprocess.Popen(
                [sys.executable, "-m", "bridged", *arguments],
                cwd=self._directory,
                env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
            )
        self._put(name, "pid", self._running[name].pid)

    def end(self) -> None:
        for process in self._running.values():
            process.terminate()
        limit = time.monotonic() + END_LIMIT_S
        for process in self._running.values():
            try:
                process.wait(max(0.0, limit - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    parent = os.getppid()
    side = HostSide(Path(sys.argv[1]).resolve())
    try:
        while os.getppid() == parent:
            side.step()
            time.sleep(POLL_INTERVAL_S)
    finally:
        side.end()


if __name__ == "__main__":
    main()
