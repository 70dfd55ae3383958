"""What waits in the interface while one bridge replaces another; test_bridge_reload.py has whole bridges."""

from typing import Any

import pytest

from bridged.bridge.hand_over import LONGEST_S, LOOK_INTERVAL_S, HandOver


class Relay:
    def __init__(self) -> None:
        self.queued = 3
        self.held = False

    def counters(self) -> dict[str, int]:
        return {"queued": self.queued}

    def hold_interface(self, held: bool) -> None:
        self.held = held


@pytest.fixture
def relay() -> Any:
    return Relay()


def test_what_was_read_is_sent_first_for_a_while(relay: Any) -> None:
    hand_over = HandOver(relay)
    hand_over.prepare(100.0, running=True)
    assert relay.held
    assert not hand_over.may_stop(100.0, running=True)
    assert hand_over.next_at == 100.0 + LOOK_INTERVAL_S
    hand_over.prepare(100.5, running=True)  # told so again: that does not delay the end
    assert not hand_over.may_stop(100.5, running=True)
    assert hand_over.may_stop(100.0 + LONGEST_S, running=True)
    assert hand_over.next_at is None
    assert relay.held


@pytest.mark.parametrize(("queued", "running"), [(0, True), (3, False)])
def test_where_nothing_is_to_be_sent_or_can_be_it_stops_at_once(
    relay: Any, queued: int, running: bool
) -> None:
    relay.queued = queued
    hand_over = HandOver(relay)
    hand_over.prepare(100.0, running=True)
    assert hand_over.may_stop(100.0, running=running)


def test_a_stop_in_the_middle_of_it_waits_for_nothing(relay: Any) -> None:
    hand_over = HandOver(relay)
    hand_over.prepare(100.0, running=True)
    hand_over.cancel()
    assert not relay.held
    assert hand_over.may_stop(100.0, running=True)


def test_frames_wait_until_the_adapter_of_the_new_bridge_is_decided(relay: Any) -> None:
    hand_over = HandOver(relay)
    hand_over.await_adapter()
    assert relay.held
    hand_over.adapter_is_decided()
    assert not relay.held


@pytest.mark.parametrize("awaits", [True, False])
def test_frames_that_wait_for_a_successor_are_not_let_go_by_the_own_adapter(relay: Any, awaits: bool) -> None:
    hand_over = HandOver(relay)
    if awaits:
        hand_over.await_adapter()
    hand_over.prepare(100.0, running=False)
    hand_over.adapter_is_decided()
    assert relay.held
