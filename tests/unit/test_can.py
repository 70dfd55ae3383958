"""bridged.can: bit timing and acceptance filters."""

from __future__ import annotations

import subprocess
import sys
import warnings

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridged import can
from bridged.adapters import firmware
from bridged.adapters.can232 import bitrate_command
from bridged.adapters.firmware.profile import BITRATES
from bridged.simulators import sja1000

with warnings.catch_warnings(action="ignore"):  # python-can 4.1 on Python 3.11
    import can as python_can

REACHABLE = sorted(
    {round(8_000_000 / (prescaler * quanta)) for prescaler in range(1, 33) for quanta in range(8, 26)}
)

needs_calculator = pytest.mark.skipif(
    not hasattr(python_can.BitTiming, "iterate_from_sample_point"), reason="python-can older than 4.3"
)


def quanta_of(btr0: int, btr1: int) -> tuple[int, int, float]:
    """Prescaler, quanta per bit, sample point, read from the SJA1000 data sheet (6.5.1, 6.5.2)."""
    before = 1 + (btr1 % 16) + 1
    after = (btr1 // 16) % 8 + 1
    return btr0 % 64 + 1, before + after, before / (before + after)


def timing_or_error(bitrate: int, sample_point: float | None) -> tuple[int, int] | str:
    try:
        return can.bit_timing(bitrate, sample_point)
    except ValueError as error:
        return str(error)


@needs_calculator
@pytest.mark.parametrize(
    ("bitrate", "sample_point", "registers"),
    [
        (125_000, None, (0x43, 0x1C)),
        (125_000, 0.875, (0x43, 0x1C)),
        (125_000, 0.75, (0xC3, 0x3A)),
        (500_000, 0.8, (0x80, 0x2B)),
        (1_000_000, 0.75, (0x40, 0x14)),
        (83_333, None, (0x45, 0x1C)),
        (33_333, None, (0x4E, 0x1C)),
        (123_077, None, (0x44, 0x19)),
        (166_666, None, (0x42, 0x1C)),
        (166_667, None, (0x42, 0x1C)),
    ],
)
def test_bit_timing(bitrate: int, sample_point: float | None, registers: tuple[int, int]) -> None:
    assert can.bit_timing(bitrate, sample_point) == registers


@needs_calculator
@pytest.mark.parametrize("bitrate", [*REACHABLE[::5], 12_882])
def test_every_reachable_bitrate_is_exact(bitrate: int) -> None:
    """Also where python-can's own choice is up to 0.4 % off, as for 12882 bit/s at 0.75."""
    for sample_point in (None, 0.75, 0.875):
        registers = timing_or_error(bitrate, sample_point)
        if isinstance(registers, str):
            assert f"{sample_point} cannot be had at {bitrate} bit/s; nearest is 0." in registers
            continue
        prescaler, quanta, actual = quanta_of(*registers)
        assert round(8_000_000 / prescaler / quanta) == bitrate
        assert sample_point is None or abs(actual - sample_point) <= 0.05
        assert can.BitTiming.from_registers(*registers) == (bitrate, registers)


@needs_calculator
def test_a_sample_point_out_of_reach_names_the_nearest() -> None:
    message = "0.875 cannot be had at 320000 bit/s; nearest is 0.68; or give btr0 and btr1"
    with pytest.raises(ValueError, match=message):
        can.bit_timing(320_000, 0.875)


@needs_calculator
def test_another_crystal() -> None:
    assert can.bit_timing(125_000, 0.875, clock_hz=32_000_000) == (0x47, 0x1C)


def test_a_python_can_that_cannot_calculate_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(python_can.BitTiming, "iterate_from_sample_point", raising=False)
    with pytest.raises(
        ValueError, match=r"83333 bit/s takes python-can 4\.3 or newer; or give btr0 and btr1"
    ):
        can.bit_timing(83_333)


@pytest.mark.parametrize(
    ("bitrate", "nearest"), [(123_456, 123_077), (999_999, 1_000_000), (10_001, 10_000), (1, 10_000)]
)
def test_bitrates_out_of_reach_name_the_nearest(bitrate: int, nearest: int) -> None:
    message = f"{bitrate} bit/s cannot be reached with the adapter's 16 MHz clock; nearest is {nearest} bit/s"
    with pytest.raises(ValueError, match=message):
        can.require_bitrate(bitrate)


@given(st.integers(1, 2_000_000))
def test_the_nearest_bitrate_is_one_that_can_be_had(bitrate: int) -> None:
    try:
        can.require_bitrate(bitrate)
    except ValueError as error:
        nearest = int(str(error).split("nearest is ")[1].split()[0])
        assert nearest in REACHABLE
        assert abs(nearest - bitrate) == min(abs(other - bitrate) for other in REACHABLE)
        can.require_bitrate(nearest)


@pytest.mark.parametrize(
    ("btr0", "btr1", "bitrate"),
    [
        (0x03, 0x1C, 125_000),  # the manual's example
        (0x00, 0x14, 1_000_000),
        (0x00, 0x1C, 500_000),
        (0x31, 0x1C, 10_000),
        (0xC3, 0x9C, 125_000),  # SJW and SAM do not count
        (0x3F, 0x7F, 5_000),
    ],
)
def test_registers(btr0: int, btr1: int, bitrate: int) -> None:
    assert can.BitTiming.from_registers(btr0, btr1) == (bitrate, (btr0, btr1))


@given(st.integers(0, 255), st.integers(0, 255))
def test_registers_mean_what_the_data_sheet_says(btr0: int, btr1: int) -> None:
    prescaler, quanta, _ = quanta_of(btr0, btr1)
    expected = round(8_000_000 / prescaler / quanta)
    if expected > 1_000_000:
        message = f"btr0 0x{btr0:02X} with btr1 0x{btr1:02X} makes {expected} bit/s; CAN ends at 1000000"
        with pytest.raises(ValueError, match=message):
            can.BitTiming.from_registers(btr0, btr1)
    else:
        assert can.BitTiming.from_registers(btr0, btr1).bitrate == expected


@pytest.mark.parametrize(
    ("timing", "command", "description"),
    [
        (can.BitTiming(125_000), b"S4\r", "125000 bit/s"),
        (can.BitTiming(10_000), b"S0\r", "10000 bit/s"),
        (can.BitTiming(800_000), b"S7\r", "800000 bit/s"),
        (can.BitTiming(125_000, (0x03, 0x1C)), b"s031C\r", "125000 bit/s by BTR0 0x03, BTR1 0x1C"),
        (can.BitTiming(83_333, (0x45, 0xFF)), b"s45FF\r", "83333 bit/s by BTR0 0x45, BTR1 0xFF"),
    ],
)
def test_can232_command(timing: can.BitTiming, command: bytes, description: str) -> None:
    assert bitrate_command(firmware.load("can232"), timing) == command
    assert timing.description == description


@pytest.mark.parametrize(
    ("bitrate", "registers"),
    [
        (1_000_000, (0x00, 0x14)),
        (800_000, (0x00, 0x16)),
        (500_000, (0x00, 0x1C)),
        (250_000, (0x01, 0x1C)),
        (125_000, (0x03, 0x1C)),
        (100_000, (0x04, 0x1C)),
        (50_000, (0x09, 0x1C)),
        (20_000, (0x18, 0x1C)),
        (10_000, (0x31, 0x1C)),
    ],
)
def test_registers_of_a_standard_bitrate(bitrate: int, registers: tuple[int, int]) -> None:
    """CiA's table, for an adapter that has no command for a bit rate. Needs no python-can."""
    assert can.BitTiming(bitrate).register_pair == registers
    assert can.BitTiming.from_registers(*registers).bitrate == bitrate
    assert sja1000.bitrate(*registers) == bitrate
    assert quanta_of(*registers)[2] >= 0.75


def test_every_standard_bitrate_has_registers() -> None:
    assert can.STANDARD_REGISTERS.keys() == BITRATES.keys()


@pytest.mark.parametrize("registers", [(0x03, 0x1C), (0x43, 0x1C), (0, 0x14)])
def test_given_registers_are_kept(registers: tuple[int, int]) -> None:
    assert can.BitTiming.from_registers(*registers).register_pair == registers
    assert can.BitTiming(125_000, registers).register_pair == registers


def test_acceptance_filter() -> None:
    single = can.AcceptanceFilter(code=0x6000, mask=0x1FF0, single=True)
    assert (single.mode, single.passes_all) == ("single", False)
    dual = can.AcceptanceFilter(code=0x6000, mask=0xFFFFFFFF)
    assert (dual.mode, dual.passes_all) == ("dual", True)


def test_nothing_heavy_is_imported() -> None:
    code = "import sys, bridged.can; print(*{'can', 'msgspec', 'yaml', 'dataclasses'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "\n"
