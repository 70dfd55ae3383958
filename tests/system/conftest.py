"""Fixtures of the tests on a real kernel with CAN: ``./dev test system`` finds or makes a place for them."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from containers import Containers, prepare
from rig import Rig


@pytest.fixture(scope="session", autouse=True)
def real_kernel() -> None:
    """Refuse, rather than skip, where these tests cannot mean anything."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        pytest.fail(f"this kernel has no CAN ({error}): use ./dev test system", pytrace=False)
    if os.geteuid() != 0:
        pytest.fail("making CAN interfaces needs root: use ./dev test system", pytrace=False)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.clear()


@pytest.fixture
def containers(tmp_path: Path) -> Iterator[Containers]:
    prepare()
    made = Containers(tmp_path)
    yield made
    made.clear()
