"""The C codec of the USB2CAN: frames there and back, any cuts, damaged streams, what a real device said.

tests/native/test_codec_usb2can_streams.c damages far more streams than this does.
"""

import itertools
import random
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridged import _relay

GOLDEN = Path(__file__).parent.parent / "golden" / "usb2can-hw0003fw0016.txt"
MESSAGE_MAX = 18
EFF, RTR = 0x80000000, 0x40000000

Message = tuple[str, bytes, int]


def decode(*pieces: bytes) -> list[Message]:
    return _relay.decode("usb2can", list(pieces))


def told(messages: list[Message]) -> tuple[list[tuple[str, bytes]], int]:
    """What does not depend on cuts: all messages but the meaningless, and how many bytes were skipped."""
    skipped = sum(length for kind, _, length in messages if kind == "skipped")
    return [(kind, body) for kind, body, _ in messages if kind not in {"skipped", "idle"}], skipped


# Data as it may come, and data full of what messages begin with.
STARTS = st.sampled_from(
    [0x0F, 0x0F, 0x41, 0x3F, 0x09, 0x0B, 0x0D, 0x06, 0x08, 0x12, 0x3E, 0x02, 0x01, 0x00, 0x88]
)


def byte_strings(min_size: int, max_size: int) -> st.SearchStrategy[bytes]:
    rich = st.lists(STARTS, min_size=min_size, max_size=max_size).map(bytes)
    return st.one_of(st.binary(min_size=min_size, max_size=max_size), rich)


@st.composite
def can_frames(draw: st.DrawFn) -> bytes:
    """A struct can_frame."""
    extended, remote = draw(st.booleans()), draw(st.booleans())
    dlc = draw(st.integers(0, 8))
    can_id = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    data = b"" if remote else draw(byte_strings(dlc, dlc))
    flags = (EFF if extended else 0) | (RTR if remote else 0)
    return (can_id | flags).to_bytes(4, "little") + bytes([dlc, 0, 0, 0]) + data.ljust(8, b"\0")


def sent(frame: bytes) -> bytes:
    return _relay.encode("usb2can", frame)


def received(frame: bytes) -> bytes:
    """As the device gives a frame to the host: what the host gives it, but for the COMMAND."""
    message = sent(frame)
    return message[:1] + b"\x41" + message[2:]


def stamped(frame: bytes, stamp: int) -> bytes:
    message = sent(frame)
    return b"\x0f\x3f" + bytes([message[2] + 2]) + message[3:] + stamp.to_bytes(2, "little")


def returned(frame: bytes, padded: bool) -> bytes:
    body = sent(frame)[3:]
    body = b"\0" + (body.ljust(13, b"\0") if padded else body)
    return b"\x0f\x09" + bytes([len(body)]) + body


ANSWERS = st.one_of(
    st.integers(0, 127).map(lambda register: bytes([0x0F, 0x12, 1, register])),
    st.tuples(st.integers(0, 127), st.integers(0, 255)).map(lambda pair: bytes([0x0F, 0x10, 2, *pair])),
    st.sampled_from([b"\x0f\x06\x01\x02", b"\x0f\x21\x0cHW0003FW0016", b"\x0f\x20\x05\x80\x0f\x07\x01\x00"]),
)
EVENTS = st.one_of(
    st.sampled_from([b"\x0f\x09\x02\x02\x01", b"\x0f\x09\x02\x02\x00", b"\x0f\x09\x01\x03"]),
    byte_strings(5, 6).map(lambda data: bytes([0x0F, 8, len(data)]) + data),
    byte_strings(5, 6).map(lambda data: bytes([0x0F, 9, 1 + len(data), 1]) + data),
)
MESSAGES = st.one_of(
    can_frames().map(received),
    can_frames().map(received),
    st.builds(stamped, can_frames(), st.integers(0, 3999)),
    st.builds(returned, can_frames(), st.booleans()),
    ANSWERS,
    EVENTS,
)


@given(can_frames())
def test_a_frame_comes_back_as_it_went(frame: bytes) -> None:
    assert decode(received(frame)) == [("frame", frame, 0)]


@given(can_frames(), st.integers(0, 3999), st.booleans())
def test_a_frame_with_a_time_stamp_or_handed_back_is_the_same(frame: bytes, stamp: int, padded: bool) -> None:
    assert decode(stamped(frame, stamp)) == [("frame", frame, 0)]
    assert decode(returned(frame, padded)) == [("returned", frame, 0)]


@given(can_frames())
def test_the_identifier_is_left_aligned(frame: bytes) -> None:
    message = sent(frame)
    can_id = int.from_bytes(frame[:4], "little")
    assert message[:3] == bytes([0x0F, 0x40, len(message) - 3])
    assert message[3] == (0x80 if can_id & EFF else 0) | (0x40 if can_id & RTR else 0) | frame[4]
    if can_id & EFF:
        assert int.from_bytes(message[4:8]) == (can_id & 0x1FFFFFFF) << 3
    else:
        assert int.from_bytes(message[4:6]) == (can_id & 0x7FF) << 5


@settings(max_examples=400)
@given(st.lists(st.one_of(MESSAGES, byte_strings(0, 12)), max_size=20), st.data())
def test_however_a_stream_is_cut_the_same_comes_out(pieces: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(pieces)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    parts = [stream[a:b] for a, b in itertools.pairwise([0, *cuts, len(stream)])]
    whole = told(decode(stream))
    assert told(decode(*parts)) == whole
    assert told(decode(*(bytes([byte]) for byte in stream))) == whole


# --- damage -----------------------------------------------------------------------------------------


class Byte(NamedTuple):
    """A byte of a stream: the place-th of a message, or of none."""

    value: int
    owner: int = -1
    place: int = 0


class Damage(NamedTuple):
    """A run of bytes that are substituted, deleted, or inserted."""

    how: str
    where: float
    run: bytes


DAMAGES = st.builds(
    Damage,
    st.sampled_from(["substitute", "delete", "insert"]),
    st.floats(0, 1, exclude_max=True),
    st.one_of(byte_strings(1, 1), byte_strings(1, 16)),
)

# After so much that is sound nothing is left in doubt.
TRAILER = b"\x0f\x12\x01\x06" * 8


def damaged(messages: list[bytes], damages: list[Damage]) -> list[Byte]:
    stream = [Byte(value, i, place) for i, m in enumerate(messages) for place, value in enumerate(m)]
    for how, where, run in damages:
        at = int(where * len(stream))
        alien = [Byte(value) for value in run]
        if how == "insert":
            stream[at:at] = alien
        elif how == "delete":
            del stream[at : at + len(run)]
        else:
            stream[at : at + len(run)] = alien[: len(stream) - at]
    return stream


class Damaged:
    """A damaged stream of which it is known what was in it."""

    def __init__(self, messages: list[bytes], damages: list[Damage]) -> None:
        self.messages = messages
        self.stream = damaged(messages, damages)
        self.bytes = bytes(byte.value for byte in self.stream) + TRAILER
        self.intact = {at: i for at, (_, i, _) in enumerate(self.stream) if self._whole(at, i)}

    def _whole(self, at: int, i: int) -> bool:
        if i < 0:
            return False
        length = len(self.messages[i])
        return [byte[1:] for byte in self.stream[at : at + length]] == [(i, place) for place in range(length)]

    def expected(self) -> list[int]:
        """Where what must come out begins: neither it nor what was before it is touched."""
        return [
            at
            for at, i in self.intact.items()
            if (at == 0 if i == 0 else self.intact.get(at - len(self.messages[i - 1])) == i - 1)
        ]

    def _message_at(self, at: int) -> int:
        """The length of the message that could be taken there, true or not; 0 if there is none."""
        for end in range(at + 3, at + MESSAGE_MAX + 1):
            if messages := decode(self.bytes[at:end]):
                return 0 if messages[0][0] == "skipped" else end - at
        return 0

    def _hidden(self, at: int, i: int) -> bool:
        """Whether messages that nobody sent hold all of it, or its beginning and then follow each other."""
        end = at + len(self.messages[i])
        for other in range(max(0, at - MESSAGE_MAX), at):
            if other in self.intact:
                continue
            other_end = other + self._message_at(other)
            if other_end >= end or (other_end > at and self._message_at(other_end)):
                return True
        return False

    def excused(self, at: int) -> bool:
        """The limits of codec_usb2can.c; for what comes after it, the hidden is as good as damaged."""
        i = self.intact[at]
        if self._hidden(at, i):
            return True
        followed = at + len(self.messages[i]) in self.intact or i + 1 == len(self.messages)
        return not followed and i > 0 and self._hidden(at - len(self.messages[i - 1]), i - 1)


def comes_out(stream: Damaged, places: list[int]) -> bool:
    """Whether the messages that begin there are all decoded, in this order."""
    found = iter(told(decode(stream.bytes))[0])
    return all(told(decode(stream.messages[stream.intact[at]]))[0][0] in found for at in places)


@settings(max_examples=300)
@given(st.lists(MESSAGES, min_size=3, max_size=20), st.lists(DAMAGES, min_size=1, max_size=4))
def test_damage_costs_what_it_touches_and_the_message_after(
    messages: list[bytes], damages: list[Damage]
) -> None:
    stream = Damaged(messages, damages)
    expected = stream.expected()
    if not comes_out(stream, expected):
        expected = [at for at in expected if not stream.excused(at)]
        assert comes_out(stream, expected), stream.bytes.hex(" ")


def random_frame(source: random.Random) -> bytes:
    dlc = source.randrange(9)
    extended = source.random() < 0.5
    can_id = source.getrandbits(29) | EFF if extended else source.getrandbits(11)
    data = bytes(source.choices((0x0F, 0x41, 0x0B, 0x08, 0x00, 0xFF), k=dlc))
    if source.random() < 0.5:
        data = source.randbytes(dlc)
    return can_id.to_bytes(4, "little") + bytes([dlc, 0, 0, 0]) + data.ljust(8, b"\0")


def test_in_a_stream_of_frames_any_single_damage_costs_no_more_than_that() -> None:
    source = random.Random(1)
    for _ in range(500):
        messages = [received(random_frame(source)) for _ in range(10)]
        for how in ("substitute", "delete", "insert"):
            stream = Damaged(messages, [Damage(how, source.random(), source.randbytes(1))])
            assert comes_out(stream, stream.expected())


# --- a real device ----------------------------------------------------------------------------------


def golden() -> tuple[bytes, list[tuple[str, bytes]]]:
    stream, expected = b"", []
    for line in GOLDEN.read_text().splitlines():
        if line and not line.startswith("#"):
            said, meaning = line.split("=")
            kind, *body = meaning.split()
            stream += bytes.fromhex(said)
            expected.append((kind, bytes.fromhex("".join(body)) if kind == "text" else b""))
    return stream, expected


@pytest.mark.parametrize("seed", range(20))
def test_what_a_real_device_said_in_any_cuts(seed: int) -> None:
    stream, expected = golden()
    source = random.Random(seed)
    cuts = sorted(source.choices(range(len(stream)), k=4 * seed))
    messages = decode(*(stream[a:b] for a, b in itertools.pairwise([0, *cuts, len(stream)])))
    assert sum(length for kind, _, length in messages if kind == "skipped") == 4
    merged = [(kind, body) for kind, body, _ in messages]
    for a, b in itertools.pairwise(range(len(merged), 0, -1)):  # noise in two pieces is one noise
        if merged[b - 1 : a] == [("skipped", b"")] * 2:
            del merged[b - 1]
    assert merged == expected
