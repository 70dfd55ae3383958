"""Counters that go on, and frames that were lost beside the relay."""

import logging
from typing import Any

import pytest

from bridged.adapters.base import Identity
from bridged.bridge.snapshot import History, settle


class Adapter:
    """What History asks of one."""

    identity = Identity("V1", "42", "one")
    sent_means = "sent means nothing"
    cautions = ("it stays warm",)


def test_who_it_is_and_what_it_does_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    history = History()
    adapter: Any = Adapter()
    with caplog.at_level(logging.INFO):
        history.adapter_runs(adapter)
        history.adapter_runs(adapter)
    assert caplog.messages == [
        "adapter version=V1 serial_number=42 firmware=one",
        "sent means nothing",
        "of this adapter: it stays warm",
    ]
    adapter.identity = Identity("V1", "43")
    history.adapter_runs(adapter)
    assert len(caplog.messages) > 3


def test_counters_go_on_with_one_that_only_one_of_the_bridges_has() -> None:
    first, second = History(), History()
    adapter: Any = Adapter()
    first.adapter_runs(adapter)
    second.continue_from(first, {"n": 2, "tx_dropped": {"stale": 3, "stopped": 1}, "bus_error": 4})
    total = second.total({"n": 1, "tx_dropped": {"stale": 5}, "restarted": 1})
    assert total == {"n": 3, "tx_dropped": {"stale": 8, "stopped": 1}, "bus_error": 4, "restarted": 1}
    assert second.starts == 0


def test_frames_lost_before_the_relay_are_no_frames_that_it_delivered() -> None:
    counters = {"rx_frames": 10, "rx_dropped": {"bus-lost": 1}, "tx_dropped": {"stale": 2}}
    settle(counters, {"socket-overflow": 3, "bus-send-failed": 4})
    assert counters == {
        "rx_frames": 6,
        "rx_dropped": {"bus-lost": 1, "bus-send-failed": 4},
        "tx_dropped": {"stale": 2, "socket-overflow": 3},
    }
