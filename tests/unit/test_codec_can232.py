"""The C codec against the simulator's reading of the manual, and against every way of cutting a stream."""

import itertools
import struct

from hypothesis import given, settings
from hypothesis import strategies as st

from bridged import _relay
from bridged.simulators.can232 import Can232
from bridged.simulators.sja1000 import Frame

FRAME = struct.Struct("=IB3x8s")
EFF, RTR = 0x80000000, 0x40000000


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    extended = draw(st.booleans())
    remote = draw(st.booleans())
    dlc = draw(st.integers(0, 8))
    data = b"" if remote else draw(st.binary(min_size=dlc, max_size=dlc))
    return Frame(draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF)), extended, remote, dlc, data)


def packed(frame: Frame) -> bytes:
    flags = (EFF if frame.extended else 0) | (RTR if frame.remote else 0)
    return FRAME.pack(frame.can_id | flags, frame.dlc, frame.data)


def opened(*settings_: bytes) -> Can232:
    """A simulated adapter with an unpaced line, its channel open."""
    device = Can232(0.0)
    for command in (*settings_, b"S8\r", b"O\r"):
        device.host_writes(0.0, command)
        device.advance(0.0)
    assert device.take_output(0.0).count(b"\r") == 2 + len(settings_)
    return device


@given(frames())
def test_what_the_codec_encodes_the_device_understands(frame: Frame) -> None:
    device = opened()
    device.host_writes(0.0, _relay.encode("can232", packed(frame)))
    device.advance(1.0)
    assert device.take_bus_frames() == [frame]


@given(st.lists(frames(), max_size=30), st.booleans(), st.floats(0, 200))
def test_what_the_device_says_the_codec_understands(sent: list[Frame], stamped: bool, now: float) -> None:
    device = opened(b"X1\r", *([b"Z1\r"] if stamped else []))
    for frame in sent:
        device.bus_frame(now, frame)
    device.advance(now)
    messages = _relay.decode("can232", [device.take_output(now)])
    assert messages == [("frame", packed(frame), 4 if stamped else 0) for frame in sent]


# What a line can carry: messages, broken ones, noise, in any mixture.
PIECES = st.one_of(
    frames().map(lambda frame: _relay.encode("can232", packed(frame))),
    frames().map(lambda frame: _relay.encode("can232", packed(frame))[:-1] + b"EA5F\r"),
    st.sampled_from([b"\r", b"\a", b"z\r", b"Z\r", b"\n", b"F04\r", b"V1324\r", b"t12", b"A\r", b"x" * 300]),
    st.binary(max_size=12),
)


@settings(max_examples=400)
@given(st.lists(PIECES, max_size=20), st.data())
def test_however_a_stream_is_cut_the_same_comes_out(pieces: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(pieces)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    edges = [0, *cuts, len(stream)]
    parts = [stream[a:b] for a, b in itertools.pairwise(edges)]

    def told(messages: list[tuple[str, bytes, int]]) -> tuple[list[tuple[str, bytes]], int]:
        skipped = sum(length for kind, _, length in messages if kind == "skipped")
        return [(kind, body) for kind, body, _ in messages if kind not in {"skipped", "idle"}], skipped

    whole = told(_relay.decode("can232", [stream]))
    assert told(_relay.decode("can232", parts)) == whole
    assert told(_relay.decode("can232", [bytes([byte]) for byte in stream])) == whole
