"""bridged/relay/counters.h is the one list of counters, drop reasons and events; all else follows it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import bridged
from bridged import _relay

STUB = Path(bridged.__file__).with_name("_relay.pyi").read_text()


def test_the_stub_has_each_event_with_its_meaning() -> None:
    wanted = [f"{name}: Final[int]  # {text}" for name, text in _relay.meanings()["events"].items()]
    assert re.findall(r"^EVENT_.*$", STUB, re.MULTILINE) == wanted, "the stub wants the lines on the right"


def test_each_event_is_a_constant_of_its_own() -> None:
    values = [getattr(_relay, name) for name in _relay.meanings()["events"]]
    assert values == list(range(len(values)))


@pytest.mark.parametrize("kind", ["counters", "tx_dropped", "rx_dropped"])
def test_each_counter_and_reason_has_a_meaning(kind: str) -> None:
    relay = _relay.Relay(
        "can232",
        queue=1,
        window=1,
        deadline=1.0,
        stuck=1.0,
        answer_timeout=1.0,
        sync=b"V\r",
        sync_prefix=b"V",
    )
    counters = relay.counters()
    counted = counters[kind] if kind != "counters" else counters.keys() - {"tx_dropped", "rx_dropped"}
    assert isinstance(counted, dict | set)
    computed = {"queued", "rx_pending"}  # not counted: how many wait now
    assert set(counted) - computed == set(_relay.meanings()[kind])
    assert all(_relay.meanings()[kind].values())
