"""A half command that another program left in a device's buffer: whatever firmware it is, the initialisation
and the closing, as the adapter performs them, put nothing on the bus and write nothing that stays."""

import contextlib
import itertools
import re

import pytest
from benches.can232_host import Host, adapter_for
from benches.clones import CAN232, FAMILIES, OF_ANOTHER_FAMILY, clone, effects

from bridged.errors import AdapterError

COMMANDS = (
    b"t1232AABB",
    b"t7A58A1B2C3D4E5F60718",
    b"t0000",
    b"T000001234AABBCCDD",
    b"T1FFFFFFF8C0C1C2C3C4C5C6C7",
    b"r1232",
    b"r7FF0",
    b"R1ABCDEF08",
    b"d1234AABBCCDD",
    b"d456F" + b"5A" * 64,
    b"D1ABCDEF09" + b"C3" * 12,
    b"b0008" + b"0123456789ABCDEF",
    b"B12345678A" + b"FE" * 16,
)
CUTS = sorted({command[:n] for command in COMMANDS for n in range(1, len(command) + 1)})
SOME_CUTS = (b"t", b"t12", b"t123", b"t1232", b"t1232A", b"t1232AAB", b"T00000123", b"r123", b"d1234AAB")


KINDS = (*FAMILIES, *OF_ANOTHER_FAMILY, CAN232)
COMPLETE = re.compile(rb"t...([0-8])(..)*|T.{8}([0-8])(..)*|r...[0-8]|R.{8}[0-8]")


def is_complete(kind: str, cut: bytes) -> bool:
    """A command that lacks no more than its CR, or not even that: no flush can keep it from being sent."""
    if kind == "slcanpty":  # the DLC of a remote frame is no part of it
        return re.fullmatch(b"r[0-9A-F]{3,4}|R[0-9A-F]{8,9}", cut) is not None
    found = COMPLETE.fullmatch(cut)
    if kind != "usbtin" or found is None:
        return False
    dlc = found[1] or found[3]
    digits = 5 if cut[:1] in b"tr" else 10
    return dlc is None or len(cut) == digits + 2 * int(dlc)


def with_half_command(kind: str, cut: bytes, *, is_open: bool) -> Host:
    """Left there a moment ago."""
    device = clone(kind, is_open=is_open)
    device.host_writes(0.0, cut)
    assert effects(device) == []  # of the cut itself
    device.take_output(0.0)
    return Host(device, adapter_for())


def lived_through(host: Host, steps_wanted: int = 1000) -> None:
    """From the first byte to the end, whatever the device makes of it."""
    with contextlib.suppress(AdapterError):
        host.start(steps_wanted)
    host.close(drain=steps_wanted % 2 == 1)


def unwanted(host: Host, kind: str, cut: bytes) -> list[str]:
    found = effects(host.device)
    if is_complete(kind, cut):
        assert set(found) <= {"frame"}
        return found[1:]
    return found


@pytest.mark.parametrize("is_open", [False, True], ids=["closed", "open"])
@pytest.mark.parametrize("kind", KINDS)
def test_no_half_command_is_completed(kind: str, is_open: bool) -> None:
    for cut in CUTS:
        host = with_half_command(kind, cut, is_open=is_open)
        lived_through(host)
        assert unwanted(host, kind, cut) == [], cut
        assert max(map(len, host.written)) <= 64, "more than a packet of USB"
        first_end = next(i for i, data in enumerate(host.written) if b"\r" in data)
        assert set(b"".join(host.written[:first_end])) == {ord("V")}
        assert len(b"".join(host.written[:first_end])) >= 200


@pytest.mark.parametrize("kind", KINDS)
def test_nor_where_the_initialisation_is_broken_off(kind: str) -> None:
    """After each step: the channel is closed in order, or by the last words."""
    for cut, steps in itertools.product(SOME_CUTS, range(1, 16)):
        host = with_half_command(kind, cut, is_open=True)
        lived_through(host, steps)
        assert unwanted(host, kind, cut) == [], (cut, steps)
        host = with_half_command(kind, cut, is_open=True)
        with contextlib.suppress(AdapterError):
            host.start(steps)
        host.device.host_writes(host.now, host.adapter.last_words)
        assert unwanted(host, kind, cut) == [], (cut, steps)


@pytest.mark.parametrize("kind", [*FAMILIES, *OF_ANOTHER_FAMILY])
def test_another_device_on_the_port_is_unknown_again(kind: str) -> None:
    """A CAN232 was there, now something else with a half command: a broken off start, then a whole one."""
    for cut, steps in itertools.product(SOME_CUTS, range(1, 16)):
        adapter = adapter_for()
        Host(clone(CAN232), adapter).start()
        host = with_half_command(kind, cut, is_open=True)
        host.adapter = adapter
        lived_through(host, steps)
        lived_through(host)
        assert unwanted(host, kind, cut) == [], (cut, steps)


def test_the_line_is_silent_between_the_flush_and_its_end() -> None:
    """For firmware that forgets half a command then, if it is not read too slowly to notice."""
    host = Host(clone(CAN232), adapter_for(baudrate=57_600))
    times = []
    device_writes = host.device.host_writes

    def timed(now: float, data: bytes) -> None:
        times.append((now, data))
        device_writes(now, data)

    host.device.host_writes = timed  # type: ignore[method-assign]
    host.start()
    (last, piece), (end, first_line) = times[3:5]
    assert (piece.strip(b"V"), first_line) == (b"", b"V\r")
    assert end - last >= 0.06 + len(piece) * 10 / 57_600
    assert end < 0.1, "the flush takes no longer than its time on the line and the pause"


@pytest.mark.parametrize("kind", ["canable2", "esp32", "usbtin"])
def test_the_simulators_notice_a_flush_that_is_too_short(kind: str) -> None:
    """That of `firmware: can232`, which only a CAN232 bears."""
    sent = set()
    for cut in CUTS:
        device = clone(kind, is_open=True)
        device.host_writes(0.0, cut)
        host = Host(device, adapter_for(firmware="can232"))
        lived_through(host)
        if "frame" in effects(device):
            sent.add(cut)
    assert {cut for cut in sent if not is_complete(kind, cut)} or kind == "usbtin"
    assert {b"t1232AABB"} <= sent if kind == "usbtin" else sent & {b"t", b"t1232AAB"}


def test_a_can232_by_the_users_word_has_the_flush_of_its_manual() -> None:
    device = clone(CAN232, is_open=True)
    device.host_writes(0.0, b"t1232AA")
    host = Host(device, adapter_for(firmware="can232"))
    host.start()
    assert host.written[:4] == [b"V" * 26 + b"\r", b"C\r", b"\r\r", b"V\r"]
    assert effects(device) == []
