"""How a device wants its frames, and what its answers to them mean: Relay.set_sending()."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from benches.relay import Rig, can_frame

from bridged import _relay
from bridged.adapters.base import Confirms, Remote, Sending

GIVEN = ("tx_frames", "tx_queued", "tx_unconfirmed")
COUNTER = {
    Confirms.TAKEN: "tx_frames",
    Confirms.SENT: "tx_frames",
    Confirms.QUEUED: "tx_queued",
    Confirms.ALWAYS: "tx_unconfirmed",
    Confirms.NOTHING: "tx_unconfirmed",
}


@pytest.fixture
def rig() -> Iterator[Rig]:
    r = Rig()
    yield r
    r.close()


def set_sending(rig: Rig, sending: Sending) -> None:
    """As bridge.py does."""
    rig.relay.set_sending(sending.confirms.value, sending.remote.value, window=sending.window or 0)


@pytest.mark.parametrize("confirms", set(Confirms) - {Confirms.NOTHING})
def test_each_confirmation_has_its_counter(rig: Rig, confirms: Confirms) -> None:
    set_sending(rig, Sending(confirms))
    rig.bus.send(can_frame(1))
    rig.turn()
    assert rig.counters()["queued"] == 1
    rig.port.send(b"z\r")
    rig.turn()
    counters = rig.counters()
    assert {name: counters[name] for name in GIVEN} == {**dict.fromkeys(GIVEN, 0), COUNTER[confirms]: 1}


def test_another_port_is_that_of_a_can232_again(rig: Rig) -> None:
    set_sending(rig, Sending(Confirms.QUEUED, window=3))
    rig.attach()
    for number in range(2):
        rig.bus.send(can_frame(number))
    rig.turn()
    assert len(rig.said()) == 1
    rig.port.send(b"z\r")
    rig.turn()
    assert (rig.counters()["tx_frames"], rig.counters()["tx_queued"]) == (1, 0)


def test_a_window_of_the_devices_own(rig: Rig) -> None:
    set_sending(rig, Sending(Confirms.QUEUED, window=3))
    for number in range(5):
        rig.bus.send(can_frame(number))
    rig.turn()
    assert len(rig.said()) == 3


def test_what_is_no_setting_is_refused(rig: Rig) -> None:
    with pytest.raises(ValueError, match="no confirmation is named 'never'"):
        rig.relay.set_sending("never", "plain", window=0)
    with pytest.raises(ValueError, match="no way to send remote frames is named 'some'"):
        rig.relay.set_sending("taken", "some", window=0)
    with pytest.raises(ValueError, match=f"window is 1 to {_relay.WINDOW_MAX}"):
        rig.relay.set_sending("taken", "plain", window=_relay.WINDOW_MAX + 1)


@pytest.mark.parametrize("remote", Remote)
@pytest.mark.parametrize("confirms", Confirms)
def test_adapters_and_relay_have_the_same_words(rig: Rig, confirms: Confirms, remote: Remote) -> None:
    set_sending(rig, Sending(confirms, remote))
