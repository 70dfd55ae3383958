"""What an adapter said once, as a capture tells, makes the same frames and the same log again."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from benches.bridge import ContractBench, run_until, started, stopped

from bridged import cli
from bridged.bridge.bridge import Bridge
from bridged.capture import Capture, escaped
from bridged.ports import open_port
from bridged.simulators import SIMULATORS, make_device, simulator
from bridged.simulators.ends import unpack
from bridged.simulators.replay import Replay
from bridged.simulators.sja1000 import Frame

GOLDEN = Path(__file__).parents[1] / "golden" / "captures"
DRIVEN = [name for name in SIMULATORS if simulator(name).ADAPTER]
PATIENCE = "30"  # this machine may be slow
POLL_S = 0.5

SENT = [Frame(0x100 + n, False, False, 2, bytes((n, 0xA5))) for n in range(4)]
RECEIVED = [Frame(0x18F00200 + n, True, False, n, bytes(range(n))) for n in range(9)]


class Run(NamedTuple):
    """What a bridge's users saw."""

    frames: list[Frame | None]
    log: list[str]


def run(bench: ContractBench, bridge: Bridge, caplog: pytest.LogCaptureFixture, *, on_bus: bool) -> Run:
    """Frames by turns, one to the device and three from it, one by one: by its bus, or by itself."""
    received: list[Frame | None] = []
    bench.bus.far.setblocking(False)

    def has(count: int) -> Callable[[], bool]:
        def look() -> bool:
            with contextlib.suppress(BlockingIOError):
                while raw := bench.bus.far.recv(16):
                    received.append(unpack(raw))
            return len(received) >= count

        return look

    def taken() -> int:
        counters = bridge.snapshot()["counters"]
        return int(counters["tx_frames"] + counters["tx_queued"] + counters["tx_unconfirmed"])

    caplog.clear()
    caplog.set_level(logging.INFO, "bridged")
    started(bridge)
    for turn, frame in enumerate(SENT):
        bench.send(frame)
        run_until(bridge, lambda turn=turn: taken() == turn + 1)
        for number in range(3 * turn, min(3 * turn + 3, len(RECEIVED))):
            arrived = has(number + 1)
            while on_bus and not arrived():  # some firmware loses one that comes while it is busy
                lost = bench.device.counters.frames_lost
                bench.send_from_its_bus(RECEIVED[number])
                run_until(bridge, lambda n=lost, a=arrived: a() or bench.device.counters.frames_lost > n)
            run_until(bridge, arrived)
    stopped(bridge)
    has(len(RECEIVED) + 1)()
    log = [
        re.sub(r"\d+(\.\d+)? (m?s)\b", r"N \2", record.getMessage())
        for record in caplog.records
        if record.name.startswith("bridged") and "simulators" not in record.name
    ]
    return Run(received, log)


def capture(
    folder: Path, name: str, caplog: pytest.LogCaptureFixture, *, masked: bool = False
) -> tuple[Path, Run]:
    """Of a session with a simulator."""
    path = folder / f"{name}.txt"
    folder = folder / "captured"
    folder.mkdir()
    with contextlib.closing(ContractBench(folder, name)) as bench:
        bench.plug_in(bench.new_device())
        bridge = bench.bridge(health_s=POLL_S)
        with contextlib.closing(Capture(path, bridge.config, masked=masked)) as written:
            bench.open_port = written.opener(bridge.config, open_port)
            return path, run(bench, bridge, caplog, on_bus=True)


def replay(folder: Path, name: str, path: Path, caplog: pytest.LogCaptureFixture) -> Run:
    """Of a bridge as it was captured, on the capture."""
    folder = folder / "replayed"
    folder.mkdir()
    with contextlib.closing(ContractBench(folder, name)) as bench:
        bench.plug_in(make_device("replay", [str(path), "--patience", PATIENCE]))
        return run(bench, bench.bridge(health_s=POLL_S), caplog, on_bus=False)


@pytest.mark.parametrize("name", DRIVEN)
def test_a_capture_replays_to_the_same_frames_and_log(
    name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, seen = capture(tmp_path, name, caplog)
    assert seen.frames == RECEIVED
    assert len(seen.log) > 3
    assert replay(tmp_path, name, path, caplog) == seen


@pytest.mark.parametrize("name", DRIVEN)
def test_a_masked_capture_replays_to_other_frames_of_the_same_kind(
    name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, seen = capture(tmp_path, name, caplog, masked=True)
    replayed = replay(tmp_path, name, path, caplog)
    assert replayed.log == seen.log
    assert len(replayed.frames) == len(seen.frames)
    others = set()
    for frame, other in zip(seen.frames, replayed.frames, strict=True):
        assert frame
        assert other
        assert (other.extended, other.remote, other.dlc) == (frame.extended, frame.remote, frame.dlc)
        assert other.can_id != frame.can_id
        assert not any(other.data)
        others.add(other.can_id)
    assert len(others) == len(RECEIVED)


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.txt")), ids=lambda path: path.stem)
def test_a_golden_capture(path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Of one session with each simulator; beside it the log. Where the bridge now says other things to an
    adapter, NEW_GOLDEN=1 in the environment makes them anew."""
    log = path.with_suffix(".log")
    if os.environ.get("NEW_GOLDEN"):
        fresh, seen = capture(tmp_path, path.stem, caplog)
        shutil.copyfile(fresh, path)
        log.write_text("\n".join(seen.log) + "\n")
        (tmp_path / "captured").rename(tmp_path / "before")
    seen = replay(tmp_path, path.stem, path, caplog)
    assert seen.frames == RECEIVED
    assert seen.log == log.read_text().splitlines()


# --- step by step -----------------------------------------------------------------------------

HEAD = "# can-bridge-capture version=0.1.0 type=can232 bitrate=125000\n"
SESSION = """\
# 1.0 opened
1.0 > VVV
1.1 > \\r
1.101 < \\x07
1.2 > V\\r
1.203 < V1324\\r
1.3 > O\\r
1.302 < \\r
2.0 < t1230\\r
3.0 > F\\r
3.001 < F00\\r
3.5 < t1231
3.501 < AA\\r
4.0 > t10011\\rt1000\\r
4.001 < z\\r
4.002 < z\\r
5.0 > F\\r
5.004 < F04\\r
6.0 > C\\r
6.001 < \\r
6.5 < X"""  # killed


def play(tmp_path: Path, text: str = SESSION, head: str = HEAD, patience_s: float = 1.0) -> Replay:
    path = tmp_path / "session"
    path.write_text(head + text)
    device = make_device("replay", [str(path), "--patience", str(patience_s)])
    assert isinstance(device, Replay)
    return device


def said(device: Replay, until: float) -> list[tuple[float, bytes]]:
    """All that it says up to then, each at its time."""
    outputs = []
    while (at := device.next_deadline()) <= until:
        outputs.append((round(at, 4), device.take_output(at)))
    return outputs


def begun(device: Replay, now: float = 100.0) -> Replay:
    """As in SESSION up to O, all at once."""
    device.host_writes(now, b"VVV\rV\rO\r")
    said(device, now + 0.01)
    return device


def test_answers_come_after_their_questions_and_frames_at_their_time(tmp_path: Path) -> None:
    device = play(tmp_path)
    assert device.state.value == "before"
    assert said(device, 1e9) == []
    device.host_writes(100.0, b"VVV")
    assert said(device, 1e9) == []
    device.host_writes(100.2, b"\rV\r")
    assert said(device, 1e9) == [(100.201, b"\a"), (100.203, b"V1324\r")]
    device.host_writes(100.3, b"O\r")
    assert said(device, 103.0) == [(100.302, b"\r"), (101.1, b"t1230\r"), (102.601, b"t1231AA\r")]
    device.host_writes(103.0, b"F\r")
    assert said(device, 103.05) == [(103.001, b"F00\r")]
    device.host_writes(103.1, b"t10011\rt1000\r")
    assert said(device, 1e9) == [(103.101, b"z\r"), (103.102, b"z\r")]
    device.host_writes(104.0, b"F\rC\r")
    assert said(device, 1e9) == [(104.004, b"F04\r\r")]  # in their order
    assert device.state.value == "ended"
    assert device.counters.frames_taken == device.counters.frames_discarded == 2
    assert device.counters.commands_missing == device.counters.commands_unknown == 0


def test_a_late_host_is_waited_for_and_an_early_one_waits(tmp_path: Path) -> None:
    device = play(tmp_path)
    device.host_writes(100.0, b"VVV\rV\r")
    device.host_writes(110.0, b"O\r")  # 9.7 s later than in the capture
    assert (110.7, b"t1230\r") in said(device, 1e9)
    device = begun(play(tmp_path))
    assert said(device, 1e9)[0] == (101.0, b"t1230\r")


def test_questions_may_be_more_or_fewer(tmp_path: Path) -> None:
    device = begun(play(tmp_path))
    answers = []
    for now in (100.1, 100.2, 100.3, 100.4):
        device.host_writes(now, b"F\r")
        answers += said(device, now + 0.01)
    assert answers == [(100.101, b"F00\r"), (100.204, b"F04\r"), (100.304, b"F04\r"), (100.404, b"F04\r")]
    device = begun(play(tmp_path))
    device.host_writes(100.1, b"C\r")
    assert said(device, 100.2) == []  # the frames' answers were before it
    assert device.counters.commands_unknown == 0


def test_a_frame_that_nobody_sends_is_not_waited_for_long(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    device = begun(play(tmp_path, patience_s=2.0))
    assert said(device, 1e9)[2:] == [(105.001, b"z\rz\r")]
    assert device.counters.frames_missing == 2
    assert caplog.text.count("the host sends no frame where it did in the capture") == 1


def test_a_command_that_is_not_in_the_capture(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    device = begun(play(tmp_path))
    device.host_writes(100.1, b"Q\rO\r")
    assert said(device, 100.2) == [(100.102, b"\r")]  # as O got before
    assert device.counters.commands_unknown == 2
    assert caplog.text.count("the host says b'Q', which it did not say here in the capture") == 1


def test_some_commands_may_be_missing(tmp_path: Path) -> None:
    device = play(tmp_path)
    device.host_writes(100.0, b"O\r")  # neither VVV nor V
    assert [data for _, data in said(device, 101.0)] == [b"\a", b"\r", b"t1230\r"]
    assert device.counters.commands_missing == 1  # V is a question


def test_repeated_commands_without_an_answer_may_be_fewer(tmp_path: Path) -> None:
    text = "1.0 > X1\\r\n1.1 < \\r\n" * 5 + "2.0 > C\\r\n2.1 < \\x07\n"
    device = play(tmp_path, text)
    device.host_writes(10.0, b"X0\rC\r")
    assert b"".join(data for _, data in said(device, 20.0)) == b"\r" * 5 + b"\a"
    assert device.counters.commands_missing == 4


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "line 1 is not that of a capture"),
        ("# something else\n", "line 1 is not that of a capture"),
        ("# can-bridge-capture version=9 type=lin\n", "type=can232 or type=usb2can"),
        (HEAD + "1.0 > V\\r\n1.0 = V\\r\n", "line 3 is not SECONDS > BYTES, or <: '1.0 = V"),
        (HEAD + "1.0 > V\\q\n", "line 2 is not"),
        (HEAD + "x\n", "line 2 is not"),
    ],
)
def test_what_is_no_capture(
    text: str, problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "file"
    path.write_text(text)
    assert cli.main(["simulate", "replay", str(path)]) == 1
    error = capsys.readouterr().err
    assert str(path) in error
    assert problem in error


def test_a_file_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["simulate", "replay", f"{tmp_path}/none"]) == 1
    assert f"{tmp_path}/none: cannot be read: No such file" in capsys.readouterr().err


def test_a_file_that_a_mail_program_has_changed(tmp_path: Path) -> None:
    """Other line ends, an empty line; and each byte comes back as it was."""
    data = bytes(range(256))
    text = f"1.0 > V\\r\r\n\r\n1.1 < {escaped(data)}\\r\r\n"
    device = play(tmp_path, text, HEAD.replace("\n", "\r\n"))
    device.host_writes(0.0, b"V\r")
    assert device.take_output(10.0) == data + b"\r"
