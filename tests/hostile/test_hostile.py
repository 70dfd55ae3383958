"""A bridge amid hostile devices (world.py): seed after seed, with each build of the extension.

CAN_BRIDGE_HOSTILE_S: seconds for each adapter and build, at least one seed; CAN_BRIDGE_HOSTILE_BUILDS: which
builds (plain,asan,tsan); CAN_BRIDGE_HOSTILE_SEED: the first seed. As set here: short, the same each time.
"""

import json
import os
import sys
import time
from collections.abc import Iterator

import pytest
from builds import BUILDS
from world import DEVICES, Run

SECONDS = float(os.environ.get("CAN_BRIDGE_HOSTILE_S", "0"))
WANTED = os.environ.get("CAN_BRIDGE_HOSTILE_BUILDS", "plain").split(",")
SEED = int(os.environ.get("CAN_BRIDGE_HOSTILE_SEED", "2"))

pytestmark = pytest.mark.timeout(300 + 2 * SECONDS)


@pytest.fixture(autouse=True)
def often() -> Iterator[None]:
    """Device and station are threads of this process, and must not wait for each other."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.0005)
    yield
    sys.setswitchinterval(before)


@pytest.mark.parametrize("build", [build for build in BUILDS if build in WANTED])
@pytest.mark.parametrize("adapter", DEVICES)
def test_it_survives_and_is_well_again(adapter: str, build: str, capsys: pytest.CaptureFixture[str]) -> None:
    end, seed = time.monotonic() + SECONDS, SEED
    while True:
        told = Run(adapter, seed, build).run()
        with capsys.disabled():  # what was done is the proof
            print(json.dumps(told), flush=True)
        seed += 1
        if time.monotonic() >= end:
            return
