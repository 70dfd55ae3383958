"""Settings of all unit tests, and the benches that many of them stand on."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

pytest.register_assert_rewrite("books", "benches")  # a failed assert in them shows its values too

from benches.bridge import Bench, Usb2canBench  # noqa: E402 - after that
from benches.families import FamilyBench  # noqa: E402 - as above

settings.register_profile("can-bridge", deadline=None)  # a slow machine is no failure
settings.load_profile("can-bridge")


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """A bridge on a simulated CAN232."""
    with contextlib.closing(Bench(tmp_path)) as made:
        yield made


@pytest.fixture
def usb2can_bench(tmp_path: Path) -> Iterator[Usb2canBench]:
    """A bridge on a simulated USB2CAN."""
    with contextlib.closing(Usb2canBench(tmp_path)) as made:
        yield made


@pytest.fixture
def family_bench(tmp_path: Path) -> Iterator[FamilyBench]:
    """A bridge on a simulated clone."""
    with contextlib.closing(FamilyBench(tmp_path)) as made:
        yield made
