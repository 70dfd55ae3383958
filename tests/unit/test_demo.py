"""`can-bridge demo`: frames both ways without any hardware."""

import argparse
import re
from typing import Any, NoReturn

import can
import pytest

from bridged import demo
from bridged.errors import NO_CAN, InterfaceError


@pytest.mark.parametrize(
    ("adapter", "word"),
    [
        ("can232", "all confirmed by the adapter"),
        ("usb2can", "all confirmed by the adapter"),
        ("canable2", r"0 confirmed by the adapter, \d+ given to it that it does not vouch for"),
    ],
)
def test_frames_go_both_ways_and_all_is_closed(
    adapter: str, word: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a kernel without CAN, so that no interface of this machine has anything to do with it."""

    def no_can(*_args: object, **_options: object) -> NoReturn:
        raise InterfaceError(NO_CAN)

    monkeypatch.setattr(demo, "open_socketcan", no_can)
    parser = argparse.ArgumentParser()
    demo.add_arguments(parser)
    assert demo.run(parser.parse_args([adapter, "--duration", "1", "--rate", "50"])) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"# Simulated {adapter.upper()} on /dev/pts/")
    assert any(line.endswith("   from the adapter") for line in lines)
    assert any(line.endswith("   to the adapter") for line in lines)
    done = next(line for line in lines if line.startswith("# Done: "))
    counts = re.search(rf"received (\d+) frames on demo, sent (\d+), {word}\.", done)
    assert counts
    assert min(map(int, counts.groups())) > 0
    assert done.endswith("Its channel is closed.")


@pytest.mark.parametrize(
    ("message", "line"),
    [
        ({"arbitration_id": 0x123, "data": b"\xaa\xbb"}, "       123   [2]  AA BB"),
        ({"arbitration_id": 0x123, "is_extended_id": True}, "  00000123   [0]  "),
        ({"arbitration_id": 1, "is_remote_frame": True, "dlc": 3}, "       001   [3]  remote request"),
    ],
)
def test_lines_are_as_candump_prints_them(message: dict[str, Any], line: str) -> None:
    fields = {"is_extended_id": False} | message
    assert demo.candump_line("vcan0", can.Message(**fields)) == f"  vcan0{line}"
