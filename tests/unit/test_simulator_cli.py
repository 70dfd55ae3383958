"""`can-bridge simulate`: options that make no sense, faults by name, and the command as a process."""

import json
import os
import random
import signal
from pathlib import Path

import pytest
from benches.simulating import START, START_ANSWER, TIMEOUT_S, ask, host, process, until

from bridged import cli
from bridged.simulators.serve import mixed_frames
from bridged.simulators.sja1000 import Frame
from bridged.simulators.usb2can import Usb2can

VERSION_ANSWER = b"\x0f\x21\x0cHW0001FW1002"


def usb2can_message(frame: Frame) -> bytes:
    """What a USB2CAN makes of a frame on its bus."""
    device = Usb2can()
    device.host_writes(0.0, START)
    device.take_output(0.0)
    device.bus_frame(0.0, frame)
    return device.take_output(0.0)


def test_the_command_simulates_a_usb2can(tmp_path: Path):
    record, state = tmp_path / "record", tmp_path / "state"
    options = (
        "--record",
        str(record),
        "--mixed",
        "--traffic",
        "5000",
        "--count",
        "200",
        "--seed",
        "5",
        "--version",
        "HW0001FW1002",
    )
    frames = [frame for frame, _ in zip(mixed_frames(random.Random(5)), range(200), strict=False)]
    with process(tmp_path, "usb2can", *options) as child:
        with host(tmp_path / "tty") as fd:
            ask(fd, START, START_ANSWER + b"".join(map(usb2can_message, frames)))
            ask(fd, b"\x0f\x21\x00", VERSION_ANSWER)
            os.write(fd, b"\x0f\x40\x05\x02\x20\x00\x11\x33")
            until(lambda: record.read_text() == "100#1133\n")
        child.send_signal(signal.SIGTERM)
        assert child.wait(TIMEOUT_S) == 0
    seen = json.loads(state.read_text())
    assert seen["state"] == "normal"
    assert seen["counters"]["frames_sent"] == 1
    assert seen["violations"] == []
    assert (seen["port"][:5], seen["host_lost"], seen["bus"]) == ("/dev/", 0, None)
    assert seen["traffic"] == {"count": 200, "made_up": 200}
    assert "uart" not in seen


def test_options_that_make_no_sense(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for options, text in (
        (["--count", "5"], "--traffic"),
        (["--record", f"{tmp_path}/no/file"], "no directory"),
        (["--record", f"{tmp_path}"], "cannot be written"),
        (["--line", f"{tmp_path}/line"], "No such file"),
    ):
        assert cli.main(["simulate", "usb2can", *options]) == 1
        assert text in capsys.readouterr().err
    for options in (["can232", "--fault", "lostgo@1"], ["usb2can", "--link", "a", "--line", "b"]):
        with pytest.raises(SystemExit):
            cli.main(["simulate", *options])
