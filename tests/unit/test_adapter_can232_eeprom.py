"""What is written to the EEPROM of a CAN232 is told: before by `can-bridge check`, then in the log."""

import logging
from pathlib import Path

import pytest
from benches.can232_host import Host, adapter_for
from benches.clones import CAN232, clone

from bridged import cli
from bridged.can import AcceptanceFilter, BitTiming
from bridged.settings import ChannelConfig


@pytest.mark.parametrize(
    ("keys", "names"),
    [
        ("", "X1 (auto poll), Z0 (no time stamps)"),
        (", acceptance: {code: 0, mask: 0xFFFFFFFF}", "X1 (auto poll), Z0 (no time stamps)"),
        (
            ", acceptance: {code: 0x6000, mask: 0x1FF0}",
            "X1 (auto poll), Z0 (no time stamps), W0 (filter mode dual)",
        ),
        (
            ", acceptance: {code: 0x6000, mask: 0x1FF0, mode: single}",
            "X1 (auto poll), Z0 (no time stamps), W1 (filter mode single)",
        ),
    ],
)
@pytest.mark.parametrize("firmware", ["", ", firmware: can232"])
def test_check_tells_before(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], keys: str, names: str, firmware: str
) -> None:
    file = tmp_path / "one.yaml"
    file.write_text(
        f"adapter: {{type: can232, port: /dev/ttyUSB0{firmware}}}\n"
        f"channel: {{bitrate: 125000{keys}}}\nbus: {{channel: vcan0}}\n"
    )
    assert cli.main(["check", str(file)]) == 0
    _, *notes = capsys.readouterr().out.splitlines()
    assert notes[0] == f"  may store in a CAN232's EEPROM, each only if it is not so already: {names}"
    clones = "  unknown firmware is refused at start, unless adapter.firmware says what it is"
    assert notes[1:] == ([] if firmware else [clones])


def test_check_tells_nothing_of_the_kind_for_a_usb2can(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "one.yaml"
    file.write_text(
        "adapter: {type: usb2can, port: /dev/ttyUSB0}\nchannel: {bitrate: 125000}\nbus: {channel: vcan0}\n"
    )
    assert cli.main(["check", str(file)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1


def test_the_log_tells_what_was_stored(caplog: pytest.LogCaptureFixture) -> None:
    channel = ChannelConfig(
        timing=BitTiming(125_000), acceptance=AcceptanceFilter(0x6000, 0x1FF0, single=True)
    )
    adapter = adapter_for(channel)
    adapter.saw_time_stamps()
    with caplog.at_level(logging.INFO):
        Host(clone(CAN232), adapter).start()
    assert [text for text in caplog.messages if "EEPROM" in text] == [
        "stored 'auto poll' (X1) in the adapter's EEPROM: it now sends received frames unasked",
        "stored 'no time stamps' (Z0) in the adapter's EEPROM: received frames now take less of its line",
        "stored 'filter mode single' (W1) in the adapter's EEPROM: it now reads code and mask as "
        "channel.acceptance means them",
    ]
