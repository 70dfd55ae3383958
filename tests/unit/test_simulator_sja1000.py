"""The simulated SJA1000: its registers in PeliCAN mode, against the data sheet (6.4 and 6.5).

Acceptance filter and bit timing are tested with the CAN232.
"""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridged.simulators.sja1000 import REGISTER_NAMES, Sja1000

AFTER_POWER_ON = {  # data sheet, table 12, "hardware reset"; CDR as the firmware leaves it
    "MOD": 0x01, "CMR": 0, "SR": 0x3C, "IR": 0, "IER": 0, "BTR0": 0, "BTR1": 0, "OCR": 0, "ALC": 0, "ECC": 0,
    "EWLR": 96, "RXERR": 0, "TXERR": 0, "RMC": 0, "RBSA": 0, "CDR": 0x80,
    **{f"{kind}{n}": 0 for kind in ("ACR", "AMR") for n in range(4)},
}  # fmt: skip
ADDRESSES = {
    "MOD": 0, "CMR": 1, "SR": 2, "IR": 3, "IER": 4, "BTR0": 6, "BTR1": 7, "OCR": 8, "ALC": 11, "ECC": 12,
    "EWLR": 13, "RXERR": 14, "TXERR": 15, "ACR0": 16, "ACR1": 17, "ACR2": 18, "ACR3": 19, "AMR0": 20,
    "AMR1": 21, "AMR2": 22, "AMR3": 23, "RMC": 29, "RBSA": 30, "CDR": 31,
}  # fmt: skip
READ_ONLY = {"SR", "IR", "ALC", "ECC", "RMC"}
ALWAYS_WRITABLE = {"CMR", "IER"}
RESET_MODE_ONLY = set(ADDRESSES) - READ_ONLY - ALWAYS_WRITABLE - {"MOD", "CDR"}


def operating(mode: int = 0) -> Sja1000:
    chip = Sja1000()
    assert chip.write(0, mode)
    assert not chip.in_reset
    return chip


def test_names_and_values_after_power_on():
    chip = Sja1000()
    assert {name: address for address, name in REGISTER_NAMES.items()} == ADDRESSES
    assert {name: chip.read(address) for name, address in ADDRESSES.items()} == AFTER_POWER_ON
    assert [chip.read(address) for address in range(256) if address not in REGISTER_NAMES] == [0] * 232


@pytest.mark.parametrize("name", sorted(RESET_MODE_ONLY))
def test_some_registers_are_written_in_reset_mode_only(name: str):
    chip = Sja1000()
    address = ADDRESSES[name]
    assert chip.write(address, 0x55)
    assert chip.read(address) == 0x55
    chip.write(0, 0x00)
    assert not chip.write(address, 0xAA)
    chip.write(0, 0x01)
    assert chip.read(address) == 0x55


@pytest.mark.parametrize("in_reset", [False, True])
def test_other_registers_do_not_depend_on_the_mode(in_reset: bool):
    chip = Sja1000() if in_reset else operating()
    assert chip.write(ADDRESSES["IER"], 0x03)
    assert chip.read(ADDRESSES["IER"]) == 0x03
    assert chip.write(ADDRESSES["CMR"], 0x0C)
    assert chip.read(ADDRESSES["CMR"]) == 0
    for address in [ADDRESSES[name] for name in READ_ONLY] + [5, 9, 10, 24, 28, 32, 127, 255]:
        before = chip.read(address)
        assert not chip.write(address, 0xFF)
        assert chip.read(address) == before


def test_the_filter_registers_cannot_be_seen_in_operating_mode():
    chip = Sja1000()
    for address in range(16, 24):
        chip.write(address, address)
    chip.write(0, 0x00)
    assert {chip.read(address) for address in range(16, 24)} == {0}
    assert (chip.code, chip.mask) == (bytes(range(16, 20)), bytes(range(20, 24)))


@pytest.mark.parametrize(
    ("found", "written", "left", "taken"),
    [
        (0x01, 0x08, 0x08, True),  # the very write that leaves reset mode
        (0x01, 0x0A, 0x0A, True),
        (0x01, 0x0F, 0x0F, True),
        (0x01, 0x11, 0x01, True),  # no sleep in reset mode
        (0x01, 0xE0, 0x00, True),  # reserved bits
        (0x08, 0x01, 0x09, True),  # the write that enters reset mode still finds operating mode
        (0x09, 0x01, 0x01, True),  # the next one does not
        (0x08, 0x00, 0x08, False),
        (0x00, 0x02, 0x00, False),
        (0x00, 0x04, 0x00, False),
        (0x02, 0x02, 0x02, True),
        (0x00, 0x10, 0x10, True),
    ],
)
def test_mode_register(found: int, written: int, left: int, taken: bool):
    chip = Sja1000()
    chip.write(0, found)
    assert chip.read(0) == found
    assert chip.write(0, written) == taken
    assert chip.read(0) == left
    assert (chip.in_reset, chip.listen_only, chip.single_filter) == (
        bool(left & 1), bool(left & 2), bool(left & 8),
    )  # fmt: skip


def test_clock_divider():
    chip = Sja1000()
    assert chip.write(31, 0xFF)
    assert chip.read(31) == 0xEF  # bit 4 is always 0
    chip.write(31, 0xC0)
    chip.write(0, 0x00)
    assert chip.write(31, 0xC7)  # the divider itself
    assert chip.read(31) == 0xC7
    assert not chip.write(31, 0x00)
    assert chip.read(31) == 0xC0
    assert chip.pelican


def test_bit_rate_follows_the_timing_registers():
    chip = Sja1000()
    for btr0, btr1, bitrate in ((0x00, 0x14, 1_000_000), (0x40, 0x1C, 500_000), (0x03, 0x1C, 125_000)):
        chip.write(6, btr0)
        chip.write(7, btr1)
        assert chip.bitrate == bitrate


def test_status_and_error_counters():
    chip = operating()
    assert chip.read(2) == 0x0C
    chip.transmitting = True
    assert chip.read(2) == 0x20
    chip.transmitting = False
    chip.count_errors(95, 95)
    assert (chip.read(2), chip.read(14), chip.read(15)) == (0x0C, 95, 95)
    for tec, rec in ((96, 0), (0, 96), (128, 128)):
        chip.count_errors(tec, rec)
        assert (chip.read(2), chip.read(14), chip.read(15)) == (0x4C, rec, tec)
    chip.set_bus_off(True)
    assert (chip.read(2), chip.read(14), chip.read(15)) == (0xCC, 0, 127)
    chip.set_bus_off(False)
    assert (chip.read(2), chip.tec, chip.rec) == (0x0C, 0, 0)
    chip.latch_error(0x1F, 0xD9)
    assert (chip.read(11), chip.read(12)) == (0x1F, 0xD9)


def test_the_warning_limit_can_be_set():
    chip = Sja1000()
    chip.write(13, 10)
    chip.count_errors(10, 0)
    assert chip.error_status
    chip.write(13, 11)
    assert not chip.error_status


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 255))))
def test_whatever_is_written_reads_back_unless_it_was_not_taken(writes: list[tuple[int, int]]):
    chip = Sja1000()
    for address, value in writes:
        before = [chip.read(n) for n in range(41)]
        was_in_reset = chip.in_reset
        taken = chip.write(address, value)
        after = [chip.read(n) for n in range(41)]
        if chip.in_reset == was_in_reset:
            changed = {n for n in range(41) if before[n] != after[n]} - {2}
            assert changed <= {address}
            if taken and address not in (0, 1, 31):
                assert after[address] == value
            elif not taken and address not in (0, 31):
                assert after[address] == before[address]
