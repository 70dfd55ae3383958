"""All benchmarks, the table at the end: run.py [--quick] [--only PART…] [--from DIRECTORY]

  counted   CPU, latency, idle, many bridges in the virtual machine that takes 1 ns for each instruction
  loss      loss in the virtual machine in real time, the adapter on this machine
  native    the floor, on this machine
  codec     the codecs alone, on this machine
  line      how much of an adapter's serial line is used, on this machine
  process   start and memory, in the virtual machine in real time

`--quick` sees whether everything works: few repetitions, two things at a time, and a status of 1 only if
something is broken, never because it was slow.
Results are in DIRECTORY (.cache/bench): samples.json, table.md, figures.svg.
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
from concurrent.futures import ThreadPoolExecutor
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


def in_vm(out: Path, commands: Sequence[str], accelerator: str) -> None:
    """Commands in one virtual machine of this kind; what they leave in /ctl is in `out` then."""
    process = subprocess.Popen(
        [TOP / "dev", "vm", "run", "-t", "2400", "-k", out, " && ".join(commands)],
        env=os.environ | {"CAN_BRIDGE_VM_ACCEL": accelerator},
        cwd=TOP,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout
    for text in process.stdout:  # by the line: two machines may run at a time
        print(f"{out.name}: {text}", end="", flush=True)
    if process.wait():
        raise subprocess.CalledProcessError(process.returncode, process.args)


def guest_command(figures_wanted: Sequence[str], quick: bool) -> str:
    """Figures of guest.py."""
    words = " ".join([*(["--quick"] if quick else []), "/ctl/samples.json", *figures_wanted])
    return f"PYTHONPATH=tests/bench python3 tests/bench/guest.py {words}"


def start_command(quick: bool) -> str:
    """Those of start.py, installed as users have it: an editable one's finder is a quarter of the start."""
    words = "--quick --frames 2000 --seconds 2 --repeat 2" if quick else "--frames 200000"
    return f"python3 tests/bench/start.py {words} --json /ctl/process.json"


def counted(_parts: Sequence[str], out: Path, quick: bool) -> dict[str, list[Sample]]:
    """`growth` first: the bridges of the others are not there yet."""
    out = out / "counted"
    wanted = ("growth", "saturation", "full-bus", "latency", "idle")
    in_vm(out, [guest_command(wanted, quick)], "icount")
    return {"counted": json.loads((out / "samples.json").read_text())}


def real_time(parts: Sequence[str], out: Path, quick: bool) -> dict[str, list[Sample]]:
    """One start of the machine for both."""
    out = out / "real-time"
    commands = {"process": start_command(quick), "loss": guest_command(["loss"], quick)}
    in_vm(out, [commands[part] for part in parts], REAL_TIME)
    found: dict[str, list[Sample]] = {}
    if "loss" in parts:
        found["loss"] = json.loads((out / "samples.json").read_text())
    if "process" in parts:
        rows = json.loads((out / "process.json").read_text())
        # An emulated processor's time is no figure; `counted` has the idle one.
        found["process"] = [
            row | {"figure": "process"} for row in rows if "processor time" not in row["name"]
        ]
    return found


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


def on_this_machine(parts: Sequence[str], out: Path, quick: bool) -> dict[str, list[Sample]]:
    functions = {"codec": codec, "line": line, "native": native}
    return {part: functions[part](out, quick) for part in parts}


Place = Callable[[Sequence[str], Path, bool], dict[str, list[Sample]]]
PLACES: dict[Place, tuple[str, ...]] = {
    on_this_machine: ("codec", "line", "native"),
    real_time: ("process", "loss"),
    counted: ("counted",),
}
PARTS = [part for parts in PLACES.values() for part in parts]


def measure(places: Sequence[Place], wanted: Sequence[str], out: Path, quick: bool) -> list[Sample]:
    """One place after the other."""
    samples: list[Sample] = []
    for place in places:
        parts = [part for part in PLACES[place] if part in wanted]
        if not parts:
            continue
        began = time.monotonic()
        print(f"bench: {', '.join(parts)}", flush=True)
        for part, found in place(parts, out, quick).items():
            samples += [sample | {"part": part} for sample in found]
        print(f"bench: {', '.join(parts)} took {time.monotonic() - began:.0f} s", flush=True)
    return samples


def measure_quickly(wanted: Sequence[str], out: Path) -> list[Sample]:
    """The machine that counts needs one processor and does not mind what the other one does."""
    with ThreadPoolExecutor() as pool:
        lanes = [
            pool.submit(measure, places, wanted, out, True)
            for places in ([counted], [on_this_machine, real_time])
        ]
        return [sample for lane in lanes for sample in lane.result()]


def like(a: Sample, b: Sample) -> bool:
    """The same thing was measured."""
    return all(a.get(key) == b.get(key) for key in ("figure", "subject", "direction", "rate"))


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
        # In one of them perhaps: this machine did not let the subject run in that time.
        if s.get("direction") != "idle" and not any(t["frames"] for t in samples if like(t, s)):
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
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
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
        if args.quick:
            samples += measure_quickly(args.only, out)
        else:
            samples += measure(list(PLACES), args.only, out, False)
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
