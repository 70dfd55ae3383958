"""Devices that are not quite what a profile describes, or something else.

Each ends in a bridge that works, or in a refusal that says why; no frame on a bus, no changed device.
"""

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from benches.can232_host import Host, adapter_for
from benches.families import FAMILIES, Family

from bridged.errors import AdapterError
from bridged.simulators import make_device
from bridged.simulators.slcan import Slcan

Change = Callable[[str, bytes], bytes]
"""The letter of a command and the answer to it → what the host hears instead."""


def changed(family: Family, change: Change, *options: str) -> Any:
    """A device of that family, with other answers."""
    device: Any = make_device(family.simulator, (*family.options, *options), now=0.0)
    answer, execute = device._answer, device._execute
    letter = ""

    def remember(at: float, line: bytes) -> bytes:
        nonlocal letter
        letter = chr(line[0]) if line else "CR"
        return execute(at, line)  # type: ignore[no-any-return]

    device._execute = remember
    device._answer = lambda at, text: answer(at, change(letter, text))
    return device


def host_of(device: Any, family: Family) -> Host:
    return Host(device, adapter_for(firmware=family.firmware if family.named else None))


def tried(host: Host) -> str:
    """Starts; why not, or an empty text."""
    try:
        host.start()
    except AdapterError as error:
        return str(error)
    return ""


def untouched(device: Slcan) -> bool:
    return device.effects == [] and device.take_bus_frames() == []


@pytest.mark.parametrize("instead", [b"", b"\a", b"\r", b"V0000\r"], ids=["silence", "BELL", "CR", "text"])
@pytest.mark.parametrize("name", FAMILIES)
def test_one_answer_is_another(name: str, instead: bytes) -> None:
    """Each in turn. What is there is not taken for something else; another try finds it as it is."""
    family = FAMILIES[name]
    for wrong in itertools.count():
        numbers = itertools.count()

        def change(
            _letter: str, answer: bytes, numbers: Iterator[int] = numbers, wrong: int = wrong
        ) -> bytes:
            return instead if answer and next(numbers) == wrong else answer

        device = changed(family, change)
        host = host_of(device, family)
        if tried(host):
            host.close()
            again = host_of(device, family)
            again.now = host.now
            host = again
            assert tried(host) == ""
        assert host.adapter.identity.firmware == family.firmware, (wrong, instead)
        assert untouched(device)
        if next(numbers) <= wrong:
            break
    assert wrong > 2


@pytest.mark.parametrize("instead", [b"", b"\a", b"\r", b"\xff\xfe"], ids=["silence", "BELL", "CR", "noise"])
@pytest.mark.parametrize("name", FAMILIES)
def test_every_answer_to_a_command_is_another(name: str, instead: bytes) -> None:
    family = FAMILIES[name]
    for letter in "VNvFCSMmAOL":
        device = changed(family, lambda asked, answer, letter=letter: instead if asked == letter else answer)
        host = host_of(device, family)
        if not tried(host):
            assert host.adapter.identity.firmware == family.firmware
        host.close()
        assert untouched(device), letter
