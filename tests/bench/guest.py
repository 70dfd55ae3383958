"""In the virtual machine: takes samples, and leaves them in a JSON file. guest.py FILE [--quick] [FIGURE…]

A sample is what load.c says of one subject, and what it was told to do. Repetitions are interleaved: each
round has every subject once, in an order that changes.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import fleet
import loss
from subjects import HERE, SUBJECTS, Load, Ours, Subject, words_of

RATES = (100, 1000, 4000, 8000)
FULL_BUS = 8000  # frames a second of 1 Mbit/s


class Session:
    """The subjects of this boot, and the samples so far."""

    def __init__(self, quick: bool) -> None:
        self.quick = quick
        self.samples: list[dict[str, Any]] = []
        self.load = Load(HERE / "build" / "load")
        self.directory = Path(tempfile.mkdtemp())
        self._started: dict[str, Subject] = {}
        self._order = random.Random(1)

    def subject(self, name: str) -> Subject:
        """Running."""
        if name not in self._started:
            subject = SUBJECTS[name](name, self.directory, self.load, vcan=f"bench{len(self._started)}")
            began = time.monotonic()
            try:
                subject.start()
            except Exception:
                print(subject.said(), file=sys.stderr)
                raise
            self._started[name] = subject
            print(f"{name}: started in {time.monotonic() - began:.1f} s", flush=True)
        return self._started[name]

    def rounds(self, repetitions: int, names: Sequence[str]) -> Iterator[tuple[int, Subject]]:
        """Every subject once per round."""
        subjects = [self.subject(name) for name in names]
        for repetition in range(repetitions):
            self._order.shuffle(subjects)
            for subject in subjects:
                yield repetition, subject

    def sample(self, figure: str, subject: Subject, repetition: int, **options: Any) -> None:
        """Take one; options of load.c."""
        before = subject.dropped() if isinstance(subject, Ours) else 0
        result = self.load.run([subject], *words_of(options))
        if isinstance(subject, Ours):
            result["told"] = subject.dropped() - before
            result["unaccounted"] = subject.unaccounted()
        self.add(figure, subject.name, repetition, options, result)

    def add(
        self, figure: str, subject: str, repetition: int, options: dict[str, Any], result: dict[str, Any]
    ) -> None:
        """One more."""
        self.samples.append(
            result | {"figure": figure, "subject": subject, "repetition": repetition, **options}
        )
        us = result["cpu_ns"] / 1e3 / max(1, result["frames"])
        latency = result.get("latency_us", {})
        print(
            f"{figure} {subject} {options}: {result['frames'] / result['wall_s']:.0f}/s {us:.1f} µs"
            f" missing={result['missing']} bunched={result['bunched']}"
            f" p50={latency.get('p50')} p99={latency.get('p99')}",
            flush=True,
        )

    def close(self) -> None:
        for subject in self._started.values():
            with contextlib.suppress(Exception):
                subject.stop()


def saturation(session: Session) -> None:
    """CPU per frame as fast as it goes, both ways."""
    repetitions, seconds, python_s = (1, 0.05, 0.1) if session.quick else (3, 0.2, 0.3)
    c_subjects = ["floor", "can-bridge", "slcanpty", "kernel-slcan", "can-bridge-usb2can"]
    wide = ["floor-wide", "can-bridge-wide"]
    for direction, names in (("to-bus", c_subjects), ("to-device", c_subjects + wide)):
        for repetition, subject in session.rounds(repetitions, names):
            session.sample(
                "saturation", subject, repetition, direction=direction, seconds=seconds, warm_up=0.05, drain=1
            )
        # In quick mode at most so many on their way: what the port has room for takes it most of a second.
        bound = {"outstanding": 128} if session.quick else {}
        for repetition, subject in session.rounds(repetitions, ["python-can"]):
            session.sample(
                "saturation", subject, repetition,
                direction=direction, seconds=python_s, warm_up=0.1, drain=2, **bound,
            )  # fmt: skip


def full_bus(session: Session) -> None:
    """What 8,000 frames a second take, as they come from a full bus."""
    repetitions, seconds = (1, 0.1) if session.quick else (3, 0.4)
    names = ["floor", "can-bridge", "can-bridge-usb2can", "slcanpty", "kernel-slcan"]
    for repetition, subject in session.rounds(repetitions, names):
        session.sample(
            "full-bus",
            subject,
            repetition,
            direction="to-bus",
            rate=FULL_BUS,
            seconds=seconds,
            warm_up=0.1,
            drain=1,
        )


def latency(session: Session) -> None:
    """One way, added. Back with a wide window: with that of 1 the line's round trip decides."""
    frames, least_s = (100, 0.05) if session.quick else (4000, 0.25)
    for rate in (RATES[0], RATES[-1]) if session.quick else RATES:
        for direction, ours in (("to-bus", "can-bridge"), ("to-device", "can-bridge-wide")):
            for repetition, subject in session.rounds(1, [ours, "slcanpty"]):
                session.sample(
                    "latency", subject, repetition, direction=direction, rate=rate,
                    seconds=max(least_s, frames / rate), warm_up=0.1, drain=1,
                )  # fmt: skip


def idle(session: Session) -> None:
    """Nothing to do."""
    seconds = 2 if session.quick else 30
    for repetition, subject in session.rounds(
        1, ["can-bridge", "can-bridge-usb2can", "slcanpty", "python-can"]
    ):
        session.sample("idle", subject, repetition, direction="idle", seconds=seconds)


FIGURES = {
    "growth": fleet.measure,  # first: no other bridge is there
    "saturation": saturation,
    "full-bus": full_bus,
    "latency": latency,
    "idle": idle,
    "loss": loss.measure,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("figures", nargs="*", choices=[[], *FIGURES], default=[])
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_intermixed_args()
    session = Session(args.quick)
    try:
        for name in args.figures or FIGURES:
            began = time.monotonic()
            FIGURES[name](session)
            print(f"{name}: {time.monotonic() - began:.0f} s", flush=True)
    finally:
        session.close()
        args.file.write_text(json.dumps(session.samples, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
