"""The extension built with sanitizers, beside a copy of the package: how to run a Python that loads it.

An error that a sanitizer finds ends the process with a status that is not 0, its report on standard error.
"""

import hashlib
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

ROOT = Path(__file__).parents[2]
CACHE = ROOT / ".cache" / "builds"
FLAGS = {
    "asan": ("-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
    "tsan": ("-fsanitize=thread",),
}
RUNTIMES = {"asan": ("libasan.so", "libubsan.so"), "tsan": ("libtsan.so",)}
OPTIONS = {
    # Python keeps what it allocates until it ends.
    "asan": {
        "ASAN_OPTIONS": "detect_leaks=0:quarantine_size_mb=16:halt_on_error=1",
        "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
        "PYTHONMALLOC": "malloc",
    },
    "tsan": {"TSAN_OPTIONS": "halt_on_error=1:exitcode=66:report_signal_unsafe=0"},
}
BUILDS = ("plain", *FLAGS)


def _library(name: str) -> str:
    return subprocess.run(
        ["gcc", f"-print-file-name={name}"], check=True, capture_output=True, text=True
    ).stdout.strip()


def _sources() -> list[Path]:
    return sorted(path for path in (ROOT / "bridged").rglob("*") if path.suffix in {".py", ".c", ".h"})


def _build(build: str) -> Path:
    """The directory to import from, made if it is missing or old."""
    folder = CACHE / build
    digest = hashlib.sha256(repr(FLAGS[build]).encode())
    for path in _sources():
        digest.update(path.read_bytes())
    stamp = folder / "of"
    if stamp.exists() and stamp.read_text() == digest.hexdigest():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(
        ROOT / "bridged", folder / "bridged", ignore=shutil.ignore_patterns("*.so", "__pycache__")
    )
    include = sysconfig.get_path("include")
    command = ["gcc", "-shared", "-fPIC", "-std=c11", "-O1", "-g", "-fno-omit-frame-pointer", "-pthread"]
    command += ["-DPy_LIMITED_API=0x030B0000", "-D_GNU_SOURCE", f"-I{include}", *FLAGS[build]]
    command += [str(path) for path in sorted((ROOT / "bridged" / "relay").glob("*.c"))]
    subprocess.run([*command, "-o", str(folder / "bridged" / "_relay.abi3.so")], check=True)
    stamp.write_text(digest.hexdigest())
    return folder


def interpreter(build: str) -> tuple[list[str], dict[str, str]]:
    """The command to run Python with this build, and what goes into its environment."""
    if build == "plain":
        return [sys.executable], {"PYTHONPATH": str(ROOT)}
    environment = {"PYTHONPATH": str(_build(build)), **OPTIONS[build]}
    environment["LD_PRELOAD"] = " ".join(map(_library, RUNTIMES[build]))
    # Its shadow memory is at addresses that a randomised layout may take.
    prefix = ["setarch", "-R"] if build == "tsan" else []
    return [*prefix, sys.executable], environment
