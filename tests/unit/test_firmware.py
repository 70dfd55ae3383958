"""Every firmware profile: what it says can be, it is recognised by one signature, the README has it."""

from __future__ import annotations

import re

import pytest
from firmware_table import README, with_table

from bridged.adapters import firmware
from bridged.adapters.base import Confirms, Reply
from bridged.adapters.can232 import LONGEST_LINE, channel_problem
from bridged.adapters.firmware.profile import Profile
from bridged.can import AcceptanceFilter, BitTiming
from bridged.settings import ChannelConfig

# What starts a bootloader, writes flash, registers or pins, or changes the answers of some firmware.
DANGEROUS = {"X", "W", "U", "Q", "N", "B", "H", "*", "b", "E", "P", "K"}
# Where a profile may say these: what they do there is known.
KNOWN_THERE = {"A": {"canable1", "canable2", "weact"}, "M": {"weact"}}

profiles = pytest.mark.parametrize(
    "profile", [firmware.load(name) for name in firmware.NAMES], ids=firmware.NAMES
)


@profiles
def test_a_profile_says_what_can_be(profile: Profile) -> None:
    sending = profile.sending
    assert profile.name in firmware.NAMES
    assert profile.longest_line >= LONGEST_LINE - 1, "its longest frame does not fit"
    assert profile.bitrates
    assert all(re.fullmatch("S[0-9A-D]", command) for command in profile.bitrates.values())
    assert len(set(profile.bitrates.values())) == len(profile.bitrates)
    assert profile.close_answers
    assert profile.answers or sending.confirms in {Confirms.NOTHING, Confirms.ALWAYS}
    assert sending.window is None or 1 <= sending.window <= 32
    assert not (sending.confirms is Confirms.SENT and sending.retries), "what it refuses may have been sent"
    assert sending.depth <= profile.buffer, "more frames than it has room for"
    assert sending.paced_bitrate is None, "that is the channel's"
    assert (sending.confirms is Confirms.NOTHING) <= profile.paced, "nothing else holds it back"
    assert profile.bus_off_flag is None or profile.flags
    assert profile.acceptance <= profile.passes_all
    assert not (profile.gentle_flush and profile.name not in {"can232", "slcanpty"}), "that needs evidence"
    for warning in (*profile.warnings, profile.listen_only_warning):
        assert not warning.endswith(".")


@profiles
def test_what_is_dangerous_elsewhere_is_never_said(profile: Profile) -> None:
    commands = [*profile.open, *(profile.listen_only or ())]
    for command in commands:
        letter = command.text[0]
        assert letter not in DANGEROUS
        assert letter not in KNOWN_THERE or profile.name in KNOWN_THERE[letter]
        assert command.text.isalnum()
    assert profile.open[-1].text == "O"


def test_every_signature_has_a_profile_or_a_name() -> None:
    assert set(firmware.SIGNATURES) == {*firmware.NAMES, *firmware.WITHOUT_PROFILE} - {"generic"}
    for name in firmware.NAMES:
        assert firmware.load(name).name == name


def test_no_version_is_that_of_two() -> None:
    """Of firmware that is known by its version alone."""
    versions = [
        "8ca5d39 https://github.com/normaldotcom/canable-fw.git",
        "b158aa7 https://github.com/normaldotcom/canable2-fw.git",
        "VL2K4",
        "VW1K2",
        "WeAct Studio V1.0.0.8_20250401",
        "+Board: X\tMCU: Y\tFirmware: 2508001\tSlcan: 100",
    ]
    for version in versions:
        assert len(firmware.Seen(version).fitting(firmware.BY_VERSION)) == 1, version
    assert not firmware.Seen("V1013").fitting(firmware.BY_VERSION)


def test_the_table_in_the_readme_is_that_of_the_profiles() -> None:
    """`./dev python tests/firmware_table.py` writes it."""
    text = README.read_text()
    assert text == with_table(text)


@pytest.mark.parametrize(
    ("name", "timing", "problem"),
    [
        ("canable2", BitTiming(800_000), "a CANable 2.0 with canable2-fw cannot be set to 800000 bit/s;"),
        ("canable1", BitTiming(800_000), "its bit rates are 10000, 20000, 50000, 100000, 125000,"),
        ("slcanuino", BitTiming(20_000), "an Arduino with slcanuino cannot be set to 20000 bit/s"),
        ("usbtin", BitTiming(125_000, (0x03, 0x1C)), "cannot be set to 125000 bit/s by BTR0 0x03, BTR1 0x1C"),
        ("weact", BitTiming(83_333, (0x05, 0x1C)), None),  # S9
        ("catompiler", BitTiming(125_000, (0x03, 0x1C)), None),
        ("can232", BitTiming(800_000), None),
    ],
)  # fmt: skip
def test_a_bit_rate_that_a_firmware_does_not_have(name: str, timing: BitTiming, problem: str | None) -> None:
    told = channel_problem(firmware.load(name), ChannelConfig(timing=timing))
    assert (told is None) if problem is None else (told is not None and problem in told)


@profiles
def test_what_else_a_firmware_does_not_have(profile: Profile) -> None:
    timing = BitTiming(125_000)
    listening = channel_problem(profile, ChannelConfig(timing=timing, listen_only=True))
    lacks = {"canable1", "canable2", "esp32", "slcanuino", "slcanpty", "generic"}
    assert (listening is not None and "has no listen-only mode" in listening) == (profile.name in lacks)
    filtering = channel_problem(profile, ChannelConfig(timing=timing, acceptance=AcceptanceFilter(0, 0x1FF0)))
    assert (filtering is None) == (profile.name == "can232")
    passing = ChannelConfig(timing=timing, acceptance=AcceptanceFilter(0, 0xFFFFFFFF))
    assert channel_problem(profile, passing) is None


def test_c_is_awaited_only_where_it_is_answered() -> None:
    unanswered = {name for name in firmware.NAMES if firmware.load(name).close_answers == (Reply.NONE,)}
    assert unanswered == {"canable1", "canable2", "elmue"}
