"""The rig itself: what can-utils send on a vcan interface is what candump logs, all of it, only it."""

import os

import pytest
from rig import Rig, assert_same_frames, mixed_frames


def test_played_frames_are_logged_exactly(rig: Rig) -> None:
    bus = rig.vcan()
    frames = mixed_frames(5000)
    dump = rig.candump(bus)
    assert rig.play(bus, frames).wait() == 0
    assert_same_frames(dump.finish(len(frames)), frames)


def test_generated_frames_are_logged_exactly_by_two_listeners(rig: Rig) -> None:
    bus = rig.vcan()
    dumps = [rig.candump(bus), rig.candump(bus)]
    assert rig.cangen(bus, 5000, "-e", "-I", "i", "-L", "2", "-D", "i").wait() == 0
    expected = [f"{n:08X}#{n.to_bytes(2, 'little').hex().upper()}" for n in range(5000)]
    for dump in dumps:
        assert_same_frames(dump.finish(5000), expected)


def test_one_frame_is_sent(rig: Rig) -> None:
    bus, other = rig.vcan(), rig.vcan()
    dump, silent = rig.candump(bus), rig.candump(other)
    rig.cansend(bus, "12345678#R5")
    assert dump.finish(1) == ["12345678#R5"]
    assert silent.finish(0) == []


def test_slcanpty_is_an_adapter(rig: Rig) -> None:
    bus = rig.vcan()
    dump = rig.candump(bus)
    _, terminal = rig.slcanpty(bus)
    port = os.open(terminal, os.O_RDWR | os.O_NOCTTY)
    os.write(port, b"O\rt1232AABB\r")
    os.close(port)
    assert dump.finish(1) == ["123#AABB"]


def test_a_difference_is_found() -> None:
    frames = mixed_frames(20)
    with pytest.raises(AssertionError, match="19 frames received, 20 expected, different from number 7 on"):
        assert_same_frames(frames[:7] + frames[8:], frames)
