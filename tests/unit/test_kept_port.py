"""An adapter that stops reading in the middle of a frame, and what becomes of its port (simulated clock)."""

import contextlib
import logging
import socket
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from benches.usb2can_relay import Rig, S, numbered, packed, rig_with

from bridged import _relay
from bridged.bridge import kept_port
from bridged.bridge.kept_port import TRIES, KeptPort
from bridged.errors import AdapterError
from bridged.simulators.sja1000 import Frame

FRAMES = [Frame(0x123, False, False, 8, bytes([0xA0 + n] * 8)) for n in range(3)]
CUTS = range(14, 29)  # at each byte of the second frame, which has 14


class Port:
    """The rig's port, as an open tty: what waits in it is lost when it is closed."""

    description = "tty"
    serial_number = None
    failure = None

    def __init__(self, rig: Rig) -> None:
        self.fd = rig.near_port.fileno()
        self._rig = rig

    def close(self) -> None:
        self.fd = -1
        self._rig.down.clear()


class Bridge:
    """What bridge.py does with a port that it gives up and opens again."""

    def __init__(self, rig: Rig, cut: int | None) -> None:
        """Frames are sent, the device reads so many bytes of them (or answers nothing), and is given up."""
        self.rig = rig
        self.kept = KeptPort(rig.relay)
        self.port = Port(rig)
        self.openings = 0
        rig.send(numbered(7))
        rig.run_until_done()
        self.kept.runs()
        rig.reads = cut
        rig.device.silent = cut is None
        for frame in FRAMES:
            rig.bus.send(packed(frame))
        rig.turn()
        while _relay.EVENT_SILENT not in [kind for kind, _, _ in rig.take_events()]:
            rig.run(0.1)
        self._close()

    def _close(self) -> None:
        self.rig.relay.set_gates(receiving=False, transmit=_relay.GATE_AWAY)
        self.rig.perform(self.rig.adapter.close_steps(drain=False))
        self.rig.relay.detach_port()
        self.kept.release(self.port)
        self.rig.run(1.0)

    def tries(self) -> bool:
        """Whether it is initialised."""
        port = self.kept.take()
        if port is None:
            self.openings += 1
            port = Port(self.rig)
        assert isinstance(port, Port)
        self.port = port
        self.rig.relay.attach_port(port.fd)
        self.kept.resume()
        try:
            self.rig.perform(self.rig.adapter.init_steps(None))
        except AdapterError:
            self._close()
            return False
        self.rig.open()
        self.kept.runs()
        return True

    def goes_on(self) -> None:
        """All is well: frames go as ever, and none was on the bus that nobody sent."""
        last = numbered(1)
        self.rig.send(last)
        assert self.rig.run_until_done()["queued"] == 0
        assert self.rig.sent[-1] == last
        assert self.rig.sent[:1] == [numbered(7)]
        assert [frame for frame in self.rig.sent[1:-1] if frame not in FRAMES] == []


def reads_on(rig: Rig) -> None:
    rig.reads = None
    rig.run(0.01)


def test_a_device_that_reads_on_before_the_next_try() -> None:
    for cut in CUTS:
        with rig_with() as rig:
            bridge = Bridge(rig, cut)
            reads_on(rig)
            assert bridge.tries()
            bridge.goes_on()
            assert (bridge.openings, rig.counters()["unanswered"]) == (0, 3)


@pytest.mark.parametrize("fruitless", [1, TRIES])
def test_a_device_that_reads_on_after_fruitless_tries(
    fruitless: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_port, "_holds_bytes", lambda port: bool(port._rig.down))
    for cut in CUTS[::4]:
        with rig_with() as rig:
            bridge = Bridge(rig, cut)
            for _ in range(fruitless):
                assert not bridge.tries()
            reads_on(rig)
            assert bridge.tries()
            bridge.goes_on()
            assert bridge.openings == 0


def test_a_device_that_reads_on_in_the_middle_of_a_try() -> None:
    for cut in CUTS:
        with rig_with() as rig:
            bridge = Bridge(rig, cut)
            rig.reads = cut  # once more so many bytes
            assert not bridge.tries()
            reads_on(rig)
            assert bridge.tries()
            bridge.goes_on()
            assert bridge.openings == 0


def test_a_device_that_was_away_gets_no_rest(caplog: pytest.LogCaptureFixture) -> None:
    """Its parser is fresh: a rest could be a command to it."""
    for cut in CUTS:
        caplog.clear()
        with rig_with() as rig, caplog.at_level(logging.WARNING):
            bridge = Bridge(rig, cut)
            rig.unplug()
            assert bridge.kept.take() is None
            assert caplog.messages[-1].endswith("(counted as unanswered): it was away meanwhile")
            rig.device.power_cycle(rig.now / S)
            reads_on(rig)
            skipped = rig.device.counters.bytes_skipped
            assert bridge.tries()
            bridge.goes_on()
            assert (bridge.openings, rig.device.counters.bytes_skipped) == (1, skipped)


def test_the_model_notices_a_port_that_is_closed() -> None:
    """What was done before: the rest is lost with the port."""
    wrong = 0
    cuts = CUTS[::4]
    for cut in cuts:
        with rig_with() as rig:
            bridge = Bridge(rig, cut)
            bridge.kept.close()
            reads_on(rig)
            with contextlib.suppress(AssertionError):
                assert bridge.tries()
                bridge.goes_on()
                wrong -= 1
            wrong += 1
            rig.device.violations.clear()
    assert wrong > len(cuts) / 2


def test_a_port_in_which_nothing_waits_is_opened_anew_in_the_end(caplog: pytest.LogCaptureFixture) -> None:
    """The device reads, but its answers do not come: a fault of the chip perhaps, which an opening mends."""
    with rig_with() as rig, caplog.at_level(logging.WARNING):
        bridge = Bridge(rig, None)
        tries = 0
        while not bridge.openings:
            assert not bridge.tries()
            tries += 1
            assert tries <= TRIES + 1
        assert caplog.messages[-1].endswith(
            "(counted as unanswered): it does not answer, though it seems to read"
        )
        rig.device.silent = False
        assert bridge.tries()
        bridge.goes_on()


def test_the_end_of_the_bridge_tells_what_to_do(caplog: pytest.LogCaptureFixture) -> None:
    with rig_with() as rig, caplog.at_level(logging.WARNING):
        bridge = Bridge(rig, 20)
        bridge.kept.close()
        assert "plug it in again before it is used anew" in caplog.messages[-1]
        assert bridge.port.fd == -1
        told = len(caplog.messages)
        bridge.kept.close()
        assert len(caplog.messages) == told


def test_another_bridge_takes_it_over(caplog: pytest.LogCaptureFixture) -> None:
    with rig_with() as rig:
        bridge = Bridge(rig, 20)
        other = KeptPort(rig.relay)
        other.take_over(bridge.kept)
        told = len(caplog.messages)
        bridge.kept.close()
        assert len(caplog.messages) == told  # nothing is lost
        bridge.kept = other
        reads_on(rig)
        assert bridge.tries()
        bridge.goes_on()
        assert bridge.openings == 0


def test_another_bridge_sends_the_rest_of_a_frame_that_the_port_took_a_part_of() -> None:
    """Its relay is another, which knows nothing of that frame but what it is told."""
    resumed: list[tuple[object, ...]] = []
    cut: Any = SimpleNamespace(cut=lambda: (True, b"a message", 3))
    other_relay: Any = SimpleNamespace(resume=lambda *rest: resumed.append(rest))
    near, far = socket.socketpair()
    with near, far:
        port: Any = SimpleNamespace(fd=near.fileno())
        kept = KeptPort(cut)
        kept.release(port)
        other = KeptPort(other_relay)
        other.take_over(kept)
        assert kept.take() is None
        assert other.take() is port
        other.resume()
    assert resumed == [(b"a message", 3)]


def test_the_rest_of_a_frame_is_for_no_device_that_comes_after_it() -> None:
    resumed: list[tuple[object, ...]] = []
    relay: Any = SimpleNamespace(
        cut=lambda: (True, b"a message", 3), resume=lambda *rest: resumed.append(rest)
    )
    near, far = socket.socketpair()
    port: Any = SimpleNamespace(fd=near.fileno(), close=near.close)
    kept = KeptPort(relay)
    far.close()
    kept.release(port)
    assert kept.take() is None
    kept.resume()
    assert resumed == []


@pytest.mark.parametrize("ends", [socket.socket.close, lambda far: far.shutdown(socket.SHUT_RDWR)])
def test_a_port_that_has_come_to_its_end_is_not_kept(ends: Callable[[socket.socket], None]) -> None:
    with rig_with() as rig:
        bridge = Bridge(rig, 20)
        ends(rig.port)
        bridge.kept.release(bridge.port)
        assert bridge.port.fd == -1
        assert bridge.kept.take() is None


@pytest.mark.parametrize("cut", [20, None])
def test_a_port_that_the_relay_could_not_have_is_what_it_was_before(cut: int | None) -> None:
    with rig_with() as rig:
        bridge = Bridge(rig, cut)
        port = bridge.kept.take()
        assert port is not None
        bridge.kept.put_back(port)
        assert bridge.kept.take() is port  # open, with what it holds
        bridge.kept.runs()
        bridge.kept.put_back(port)
        assert (port.fd, bridge.kept.take()) == (-1, None)
