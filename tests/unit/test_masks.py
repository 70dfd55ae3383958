"""What a mask makes of the bytes of a line: other frames of the same kind and length, however it is cut."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable

import pytest

from bridged.adapters import TYPES
from bridged.adapters.masks import MASKS, MaskedIds
from bridged.simulators.serve import mixed_frames
from bridged.simulators.sja1000 import Frame
from bridged.simulators.slcan import frame_of
from bridged.simulators.usb2can_messages import frame_in_transmit_buffer, message, receive_buffer_of

WRITE, READ_STAMPED, READ, ERROR = 64, 63, 65, 9


def line_of(frame: Frame, stamp: bytes = b"") -> bytes:
    letter = b"tTrR"[2 * frame.remote + frame.extended :][:1]
    can_id = b"%08X" % frame.can_id if frame.extended else b"%03X" % frame.can_id
    return letter + can_id + b"%d" % frame.dlc + frame.data.hex().upper().encode() + stamp + b"\r"


def in_small_letters(frame: Frame) -> bytes:
    line = line_of(frame)
    return line[:1] + line[1:].lower()


def of_line(line: bytes) -> Frame:
    return frame_of(line[:1], line[1:-1])


def to_device(frame: Frame) -> bytes:
    data = frame.data
    head = frame.extended << 7 | frame.remote << 6 | frame.dlc
    shifted = (frame.can_id << 3).to_bytes(4) if frame.extended else (frame.can_id << 5).to_bytes(2)
    return message(WRITE, bytes((head,)) + shifted + data)


def to_host(frame: Frame) -> bytes:
    return message(READ, receive_buffer_of(frame))


def stamped(frame: Frame) -> bytes:
    return message(READ_STAMPED, receive_buffer_of(frame) + b"\x12\x03")


def handed_back(frame: Frame) -> bytes:
    return message(ERROR, b"\0" + to_device(frame)[3:])


def of_message(raw: bytes) -> Frame:
    data = raw[4:] if raw[1] == ERROR else raw[3:-2] if raw[1] == READ_STAMPED else raw[3:]
    frame = frame_in_transmit_buffer(data)
    assert frame is not None
    return frame


FLUSH, NOISE = b"V" * 200, b"\x0f\xff\x11"
LINES = b"\r \a z\r Z\r V1013\r NA123\r F00\r S6\r A\r Tiny_2_CAN\r b158aa7_https://github.com/normaldotcom/canable-fw.git\r".split(
    b" "
)
MESSAGES = [
    b"\xff\xff",
    message(33, b"HW0003FW0016"),
    message(18, b"\x06\x40"),
    message(9, b"\x02\x01"),
    message(2),
]

# How frames are written and read, and what else is said on the line.
WAYS: dict[str, tuple[list[Callable[[Frame], bytes]], Callable[[bytes], Frame], list[bytes]]] = {
    "can232": (
        [line_of, lambda frame: line_of(frame, b"1A2B"), in_small_letters],
        of_line,
        [*LINES, FLUSH],
    ),
    "usb2can": ([to_device, to_host, stamped, handed_back], of_message, [*MESSAGES, NOISE]),
}


def test_each_type_of_adapter_has_one() -> None:
    assert MASKS.keys() == TYPES.keys() == WAYS.keys()


def cut(data: bytes, rng: random.Random) -> list[bytes]:
    places = sorted(rng.choices(range(len(data)), k=rng.randrange(len(data) // 3)))
    return [data[start:end] for start, end in itertools.pairwise((0, *places, len(data)))]


@pytest.mark.parametrize("type_", MASKS)
@pytest.mark.parametrize("seed", range(20))
def test_frames_become_others_of_their_kind_and_the_rest_stays(type_: str, seed: int) -> None:
    rng = random.Random(seed)
    ways, read, others = WAYS[type_]
    few = [frame for frame, _ in zip(mixed_frames(rng), range(30), strict=False)]
    said: list[tuple[bytes, Frame | None]] = []
    for _ in range(300):
        frame = rng.choice(few)
        way = rng.choice(ways)
        said.append((way(frame), frame) if rng.random() < 0.7 else (rng.choice(others), None))
        if said[-1][0] in (FLUSH, NOISE):  # what follows does not begin a frame
            said.append((b"\r" if type_ == "can232" else b"\xff", None))
    original = b"".join(raw for raw, _ in said)
    ids = MaskedIds()
    mask = MASKS[type_](ids)
    pieces = [mask.feed(piece) for piece in cut(original, rng)]
    masked = b"".join([*pieces, mask.flush()])
    assert len(masked) == len(original)
    assert masked == MASKS[type_](ids).feed(original)  # the cut makes no difference
    became: dict[tuple[bool, int], int] = {}
    at = 0
    for raw, frame in said:
        after = masked[at : at + len(raw)]
        at += len(raw)
        if frame is None:
            assert after == raw
            continue
        other = read(after)
        assert (other.extended, other.remote, other.dlc) == (frame.extended, frame.remote, frame.dlc)
        assert not any(other.data)
        assert after[:1] == raw[:1]
        assert other.can_id == became.setdefault((frame.extended, frame.can_id), other.can_id)
        assert other.can_id != frame.can_id
    assert len({(extended, other) for (extended, _), other in became.items()}) == len(became)


@pytest.mark.parametrize(
    ("type_", "said", "masked"),
    [
        ("can232", b"t12", b"t00"),  # the rest is lost
        ("can232", b"T0012\xf2ABC\r", b"T0000\xf2000\r"),
        ("can232", b"t" + b"12" * 100 + b"34\r", b"t" + b"00" * 100 + b"00\r"),
        ("can232", b"b12", b"b12"),  # no frame
        ("can232", b"M12345678\rmFFFFFFFF\rM1\r", b"M00000000\rm00000000\rM1\r"),
        ("usb2can", bytes.fromhex("0F41 05 0224"), bytes.fromhex("0F41 05 0000")),
        ("usb2can", bytes.fromhex("0F41 02 0224"), bytes.fromhex("0F41 02 0200")),  # too short for a frame
        ("usb2can", bytes.fromhex("0F12 02 10A5"), bytes.fromhex("0F12 02 1000")),
        ("usb2can", bytes.fromhex("0F12 01 10"), bytes.fromhex("0F12 01 10")),
    ],
)
def test_what_is_no_whole_frame(type_: str, said: bytes, masked: bytes) -> None:
    for size in (1, len(said)):
        mask = MASKS[type_](MaskedIds())
        pieces = [mask.feed(said[at : at + size]) for at in range(0, len(said), size)]
        assert b"".join([*pieces, mask.flush()]) == masked


def test_a_line_that_lost_its_end_hides_the_next_frame_too() -> None:
    mask = MASKS["can232"](ids := MaskedIds())
    standard, extended = ids.standard(0x123), ids.extended(0x12345678)
    assert mask.feed(b"t1232AT1234567810F\r") == b"t%03X20T%08X100\r" % (standard, extended)


def test_frames_of_can_fd() -> None:
    mask = MASKS["can232"](ids := MaskedIds())
    standard, extended = ids.standard(0x123), ids.extended(0x12345678)
    assert mask.feed(b"d1239" + b"AB" * 12 + b"\rB123456780\r") == b"d%03X9" % standard + b"00" * 12 + (
        b"\rB%08X0\r" % extended
    )


def test_every_standard_identifier_becomes_another() -> None:
    ids = MaskedIds()
    others = [ids.standard(can_id) for can_id in range(0x800)]
    assert sorted(others) == list(range(0x800))
    assert all(can_id != other for can_id, other in enumerate(others))
