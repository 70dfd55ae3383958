"""Every simulator of the registry keeps the contract of bridged/simulators/device.py."""

from __future__ import annotations

import random
import subprocess
import sys

import pytest
from benches.simulating import OPTIONS

from bridged import cli
from bridged.adapters import TYPES
from bridged.simulators import SIMULATORS, make_device, simulator
from bridged.simulators.device import Device, SimulatorModule
from bridged.simulators.faults import FAULTS, Fault, begin, end, meanings, parse_fault, repeated
from bridged.simulators.sja1000 import Frame

pytestmark = pytest.mark.parametrize("name", SIMULATORS)


def members(protocol: type) -> set[str]:
    return {name for name in {*vars(protocol), *protocol.__annotations__} if not name.startswith("_")}


def test_it_has_all_that_the_contract_asks_for(name: str) -> None:
    module = simulator(name)
    device = make_device(name, OPTIONS.get(name, ()))
    assert members(SimulatorModule) - set(dir(module)) == set()
    assert members(Device) - set(dir(device)) == set()
    assert device.own_faults is module.FAULTS
    assert module.ADAPTER.get("type") in {*TYPES, None}
    assert device.title


def test_it_is_made_at_its_uart_rate(name: str) -> None:
    uart = getattr(make_device(name, OPTIONS.get(name, ()), uart_rate=38_400), "uart", None)
    assert uart is None or uart.baud == 38_400


def test_every_fault_comes_and_goes(name: str) -> None:
    device = make_device(name, OPTIONS.get(name, ()), now=0.0)
    for kind in meanings(device.own_faults):
        fault = parse_fault(f"{kind}@0+1", meanings(device.own_faults))
        action = repeated(device, fault, random.Random(0))
        begin(device, fault, 1.0)
        if action:
            action(1.0)
        end(device, fault, 2.0)
        if kind in FAULTS:
            assert (action is not None) == (kind == "garbage")
    assert (device.silent, device.refusals, device.drop_answers) == (False, 0, 0)
    for own in device.own_faults.values():
        assert (own.switch is None) != (own.burst is None)
        assert own.meaning


def test_no_power_is_no_service(name: str) -> None:
    device = make_device(name, OPTIONS.get(name, ()), now=0.0)
    begin(device, Fault("poweroff", 0, 1), 1.0)
    device.host_writes(1.0, b"V\r\x0f\x21\x00")
    device.bus_frame(1.0, Frame(0x100, False, False, 0, b""))
    assert device.take_output(2.0) == b""
    assert device.counters.frames_received == 0
    end(device, Fault("poweroff", 0, 1), 3.0)
    assert device.take_bus_frames() == []


def test_every_fault_is_explained(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["simulate", name, "--help"])
    shown = "".join(capsys.readouterr().out.split())
    for kind, meaning in meanings(simulator(name).FAULTS).items():
        assert f"{kind}: {meaning}".replace(" ", "") in shown


def test_no_other_simulator_is_loaded(name: str) -> None:
    command = ["simulate", name, *OPTIONS.get(name, ())]
    code = (
        "import sys; from bridged import cli; from bridged.simulators import SIMULATORS\n"
        f"cli._parser({command}).parse_args({command})\n"
        "print(*(name for name, module in SIMULATORS.items() if module in sys.modules))"
    )
    loaded = subprocess.check_output([sys.executable, "-c", code], text=True).split()
    assert name in loaded
    assert len(loaded) <= 2  # a clone may build on the file of another
