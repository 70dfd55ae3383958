"""On this machine, at its own speed, without CAN: the floor. host.py FILE [--quick]

The bus is a socketpair, the port a pseudo terminal.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from subjects import HERE, SUBJECTS, Load, Ours, Subject


def shown(sample: dict[str, Any]) -> str:
    us = sample["cpu_ns"] / 1e3 / max(1, sample["frames"])
    rate = sample["frames"] / sample["wall_s"]
    name = f"{sample['figure']} {sample['subject']} {sample['direction']}"
    return f"{name}: {rate:.0f}/s {us:.2f} µs missing={sample['missing']} told={sample.get('told')}"


@contextlib.contextmanager
def started(load: Load, directory: Path, *names: str) -> Iterator[list[Subject]]:
    """Subjects of these kinds, running."""
    subjects = [
        SUBJECTS[name](name, Path(tempfile.mkdtemp(dir=directory)), load, vcan=None) for name in names
    ]
    try:
        for subject in subjects:
            subject.start()
        yield subjects
    finally:
        for subject in subjects:
            subject.stop()


def floor(load: Load, directory: Path, quick: bool) -> Iterator[dict[str, Any]]:
    """CPU per frame as fast as it goes, beside the floor."""
    repetitions, seconds = (2, 0.3) if quick else (15, 1.0)
    with started(load, directory, "floor", "can-bridge", "floor-wide", "can-bridge-wide") as subjects:
        for repetition in range(repetitions):
            for subject in subjects:
                for direction in ("to-bus", "to-device"):
                    if direction == "to-bus" and subject.name.endswith("-wide"):
                        continue  # the window is that of the other direction
                    options = ("--direction", direction, "--seconds", seconds, "--warm-up", 0.1)
                    before = subject.dropped() if isinstance(subject, Ours) else 0
                    sample = load.run([subject], *options)
                    if isinstance(subject, Ours):
                        sample["told"] = subject.dropped() - before
                        sample["unaccounted"] = subject.unaccounted()
                    yield sample | {
                        "figure": "floor", "subject": subject.name, "direction": direction,
                        "repetition": repetition,
                    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    load = Load(HERE / "build" / "load")
    samples = []
    with tempfile.TemporaryDirectory() as name:
        for sample in floor(load, Path(name), args.quick):
            samples.append(sample)
            print(shown(sample), flush=True)
    args.file.write_text(json.dumps(samples, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
