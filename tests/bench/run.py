"""All benchmarks, the table at the end: run.py [--quick] [--only PART…] [--from DIRECTORY]

  counted   CPU, latency, idle in the virtual machine that takes 1 ns for each instruction
  loss      loss in the virtual machine in real time, the adapter on this machine
  native    the floor, and many bridges, on this machine
  codec     the codecs alone, on this machine
  line      how much of an adapter's serial line is used, on this machine
  process   start and memory, in the virtual machine in real time

`--quick` sees whether everything works: few repetitions, and a status of 1 only if something is broken, never
because it was slow. Results are in DIRECTORY (.cache/bench): samples.json, table.md, figures.svg.
With `--only` the samples of the other parts stay as they were.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import figures
import report

HERE = Path(__file__).resolve().parent
TOP = HERE.parents[1]
BUILD = HERE / "build"
SOURCES = {"load": ("load.c", "load_port.c", "load_probe.c"), "floor": ("floor.c",)}
PYTHON_CAN = "python-can==4.6.1"  # the peer; the newest there was
REAL_TIME = os.environ.get("CAN_BRIDGE_VM_ACCEL", "tcg")
WARNINGS = ("-std=c11", "-O2", "-Wall", "-Wextra", "-Werror")

Sample = dict[str, Any]


def build() -> None:
    """The C programs and the peer from PyPI; the guest has neither compiler nor network."""
    BUILD.mkdir(exist_ok=True)
    for name, sources in SOURCES.items():
        subprocess.run(["gcc", *WARNINGS, *sources, "-o", BUILD / name], cwd=HERE, check=True)
    peer = BUILD / "python-can"
    if not peer.exists():
        install = [sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--target"]
        subprocess.run([*install, str(peer), PYTHON_CAN], check=True)


def in_vm(out: Path, command: str, accelerator: str) -> None:
    """A command in a virtual machine of this kind; what it leaves in /ctl is in `out` then."""
    subprocess.run(
        [TOP / "dev", "vm", "run", "-t", "1500", "-k", out, command],
        env=os.environ | {"CAN_BRIDGE_VM_ACCEL": accelerator},
        cwd=TOP,
        check=True,
    )


def in_guest(out: Path, figures_wanted: Sequence[str], accelerator: str, quick: bool) -> list[Sample]:
    """Figures of guest.py."""
    words = " ".join([*(["--quick"] if quick else []), "/ctl/samples.json", *figures_wanted])
    in_vm(out, f"PYTHONPATH=tests/bench python3 tests/bench/guest.py {words}", accelerator)
    return list(json.loads((out / "samples.json").read_text()))


def counted(out: Path, quick: bool) -> list[Sample]:
    return in_guest(out, ("saturation", "full-bus", "latency", "idle"), "icount", quick)


def loss(out: Path, quick: bool) -> list[Sample]:
    return in_guest(out, ("loss",), REAL_TIME, quick)


def native(out: Path, quick: bool) -> list[Sample]:
    file = out / "native.json"
    words = ["--quick"] if quick else []
    subprocess.run([sys.executable, HERE / "host.py", *words, file], check=True)
    return list(json.loads(file.read_text()))


def codec(_out: Path, _quick: bool) -> list[Sample]:
    """What tests/native/bench_codec.c prints for each compiler."""
    done = subprocess.run(
        ["sh", TOP / "tests/native/run.sh", "bench"], check=True, capture_output=True, text=True
    )
    print(done.stdout)
    samples, compiler = [], ""
    for line in done.stdout.splitlines():
        found = re.fullmatch(r"(\w+) (encode|decode) (.*?) +([\d.]+) M/s", line)
        if found:
            keys = ("codec", "way", "message")
            sample = dict(zip(keys, found.groups()[:3], strict=True)) | {"millions": float(found[4])}
            samples.append({"figure": "codec", "compiler": compiler, **sample})
        else:
            compiler = line.strip()
    return samples


def line(_out: Path, quick: bool) -> list[Sample]:
    words = ["--seconds", "1", "--repeat", "1"] if quick else []
    done = subprocess.run(
        [sys.executable, HERE / "line_use.py", *words], check=True, capture_output=True, text=True
    )
    print(done.stdout)
    found = re.findall(r"window (\d+): ([\d.]+)% of (\d+) frames/s, (\d+) characters lost", done.stdout)
    return [
        {
            "figure": "line",
            "window": int(w),
            "percent": float(percent),
            "limit": int(limit),
            "lost": int(lost),
        }
        for w, percent, limit, lost in found
    ]


def process(out: Path, quick: bool) -> list[Sample]:
    """As users have it installed: the finder of an editable package is a quarter of the start."""
    words = "--quick --frames 2000 --seconds 2 --repeat 2" if quick else "--frames 200000"
    in_vm(out, f"python3 tests/bench/start.py {words} --json /ctl/process.json", REAL_TIME)
    rows = json.loads((out / "process.json").read_text())
    # An emulated processor's time is no figure; `counted` has the idle one.
    return [row | {"figure": "process"} for row in rows if "processor time" not in row["name"]]


PARTS: dict[str, Callable[[Path, bool], list[Sample]]] = {
    "codec": codec, "line": line, "native": native, "process": process, "counted": counted, "loss": loss,
}  # fmt: skip


def broken(samples: Sequence[Sample]) -> list[str]:
    """What no machine may be too slow for."""
    wrong = []
    for s in samples:
        if s["figure"] in {"codec", "process", "line"}:
            continue
        name = f"{s['figure']} {s['subject']} {s.get('direction', '')} {s.get('rate', '')}".strip()
        ours = s["subject"].startswith("can-bridge")
        if s["figure"] == "loss":
            if ours and (s["unaccounted"] or s["books"] or s["adapter_characters_lost"]):
                wrong.append(f"{name}: frames lost that nobody counted, or in the adapter")
            if not s["taken"]:
                wrong.append(f"{name}: the adapter got nothing")
            continue
        if s.get("direction") != "idle" and not s["frames"]:
            wrong.append(f"{name}: no frames")
        if s.get("misordered") and ours:
            wrong.append(f"{name}: frames changed their order")
        if "told" in s and s["missing"] != s["told"]:
            wrong.append(f"{name}: {s['missing']} frames are missing, {s['told']} are counted as dropped")
        if s["missing"] and s["subject"].startswith("floor"):
            wrong.append(f"{name}: {s['missing']} frames are missing")
        if s.get("unaccounted"):
            wrong.append(f"{name}: the counters do not add up")
    return wrong


def rows_of(samples: Sequence[Sample]) -> list[figures.Row]:
    """All rows there are samples for."""
    return [row for figure in figures.FIGURES for row in figure(samples)]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, default=TOP / ".cache" / "bench", metavar="DIRECTORY")
    parser.add_argument(
        "--from", dest="old", type=Path, metavar="FILE", help="the table of these samples again"
    )
    args = parser.parse_args()
    out: Path = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    kept = args.old or out / "samples.json"
    samples: list[Sample] = json.loads(kept.read_text()) if kept.exists() else []
    if not args.old:
        build()
        samples = [sample for sample in samples if sample.get("part") not in args.only]
        for part in args.only:
            began = time.monotonic()
            print(f"bench: {part}", flush=True)
            samples += [sample | {"part": part} for sample in PARTS[part](out, args.quick)]
            print(f"bench: {part} took {time.monotonic() - began:.0f} s", flush=True)
    (out / "samples.json").write_text(json.dumps(samples, indent=1) + "\n")
    rows = rows_of(samples)
    (out / "table.md").write_text(report.markdown(rows))
    (out / "figures.svg").write_text(report.svg(rows))
    print(report.text(rows))
    print(f"\nbench: {out}/samples.json, table.md, figures.svg")
    wrong = broken(samples)
    for problem in wrong:
        print(f"bench: BROKEN: {problem}", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
