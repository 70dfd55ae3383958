"""Devices that are not quite what a profile describes, or something else.

Each ends in a bridge that works, or in a refusal that says why; no frame on a bus, no changed device.
"""

import itertools
import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from benches.bridge import run_until, stopped
from benches.can232_host import Host, adapter_for
from benches.families import FAMILIES, Family, FamilyBench

from bridged import _relay
from bridged.adapters.base import Answer, Exchange, Reply
from bridged.bridge.lifecycle import State
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


class Late(Host):
    """Each answer comes so much later; after a time limit, it is there with the next question."""

    def __init__(self, device: Any, family: Family, late_s: float) -> None:
        super().__init__(device, adapter_for(firmware=family.firmware if family.named else None))
        self.late_s = late_s
        self.under_way: list[tuple[float, bytes]] = []

    def _ask(self, exchange: Exchange) -> Answer:
        list(self._unasked(self._messages()))
        self.written.append(exchange.request)
        self.device.host_writes(self.now, exchange.request)
        end = self.now + exchange.timeout_s
        while self.now < end:
            self.now += 0.01
            for reply, text in list(self._unasked(self._messages(), exchange.prefix)):
                if reply in {*exchange.accept, *exchange.reject}:
                    return Answer(reply, text)
        return Answer(Reply.NONE)

    def _messages(self) -> list[tuple[str, bytes, int]]:
        if output := self.device.take_output(self.now):
            self.under_way.append((self.now + self.late_s, output))
        here = [output for at, output in self.under_way if at <= self.now]
        self.under_way = self.under_way[len(here) :]
        return _relay.decode("can232", [b"".join(here)])


@pytest.mark.parametrize("late_s", [0.1, 0.3, 0.4, 0.8, 2.0])
@pytest.mark.parametrize("name", FAMILIES)
def test_answers_come_late(name: str, late_s: float) -> None:
    family = FAMILIES[name]
    device: Any = make_device(family.simulator, family.options, now=0.0)
    host = Late(device, family, late_s)
    told = tried(host)
    assert untouched(device)
    if late_s < adapter_for().answer_timeout_s:
        assert told == ""
    if not told:
        assert host.adapter.identity.firmware == family.firmware


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("canable1", "v1.2-3-g1234567 https://github.com/normaldotcom/canable-fw.git"),
        ("canable2", "0a1b2c3 https://github.com/normaldotcom/canable2-fw.git"),
        ("nakakiyo", "VL2K1"),
        ("nakakiyo", "VL2K12"),
        ("nakakiyo-vw1k", "VW1K3"),
        ("weact", "WeAct Studio V2.0.0.0_20270101"),
        ("elmue", "+Board: OpenlightLabs\tMCU: STM32G431\tFirmware: 2602019\tSlcan: 101\tSerial: 0123"),
        ("elmue", "+Board: OpenlightLabs\tMCU: STM32G431\tFirmware: 2602019\tSlcan: 101"),
        ("catompiler", "V0205"),
    ],
)
def test_another_release_of_a_known_firmware(name: str, version: str) -> None:
    family = FAMILIES[name]
    device: Any = make_device(family.simulator, ("--version", version), now=0.0)
    host = host_of(device, family)
    assert tried(host) == ""
    assert host.adapter.identity.firmware == family.firmware


@pytest.mark.parametrize(
    "version", ["SLCAN 1.0", "V99", "VL3K1", "VL2", "weact 1", "+Board: Some\tMCU: Other", "V1324", "V", "?"]
)
@pytest.mark.parametrize("name", FAMILIES.keys() - {"slcanpty", "catompiler"})
def test_an_unknown_answer_to_the_version(name: str, version: str) -> None:
    """Also the one of a CAN232: what else the device says speaks against that."""
    device: Any = make_device(FAMILIES[name].simulator, ("--version", version), now=0.0)
    host = host_of(device, FAMILIES[name])
    told = tried(host)
    assert told
    host.close()
    assert untouched(device)
    if "answers V with" in told:
        assert repr(version) in told
        assert "say so by `firmware:`" in told


class Stranger(Slcan):
    """No CAN adapter. `lines`: what it was told."""

    def __init__(self, answer: bytes, *, echo: bool = False, talk: bytes = b"") -> None:
        super().__init__(0.0)
        self.answer, self.echo, self.talk = answer, echo, talk
        self.lines: list[bytes] = []
        self.due = 0.0

    def _store(self, at: float, byte: int) -> None:
        self._line.append(byte)
        if self.echo:
            self._say(at, bytes((byte,)))

    def _execute(self, _at: float, line: bytes) -> bytes:
        self.lines.append(line)
        return b"\r" * self.echo + self.answer

    def timer(self) -> float:
        return self.due if self.talk else math.inf

    def on_timer(self, now: float) -> None:
        self._say(now, self.talk)
        self.due = now + 0.1


NMEA = (
    b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
    b"$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\r\n"
)
HARMLESS = re.compile(rb"V*|N|v|F|C")


@pytest.mark.parametrize(
    ("stranger", "shown"),
    [
        (Stranger(b"", talk=NMEA), "GP"),
        (Stranger(b"?\r\r>"), "?'"),
        (Stranger(b"\n?\r\n\r\n>", echo=True), ""),
        (Stranger(b'\necho:Unknown command: "V"\nok\n', talk=b"start\necho:Marlin 2.1.2\n"), ""),
        (Stranger(b"\nERROR\r\n", echo=True), ""),
        (Stranger(b"\r\nERROR\r\n"), "ERROR"),
        (Stranger(b"", echo=True), ""),
    ],
    ids=["GPS", "ELM327", "ELM327 with echo", "Marlin", "modem", "modem without echo", "loopback"],
)
def test_something_else(family_bench: FamilyBench, stranger: Stranger, shown: str) -> None:
    """It is refused, nothing that might mean something to it is sent, and no frame comes of what it says."""
    family_bench.plug_in(stranger)
    bridge = family_bench.configured({})
    bridge.start()
    run_until(bridge, lambda: bridge.state in {State.FAULT, State.BACKOFF})
    reason = bridge.reason
    status = stopped(bridge)
    family_bench.pull_out()
    assert shown in reason
    assert re.search(
        "no firmware that is known|no answer to V|only noise|refuses every|an empty line", reason
    )
    assert [line for line in stranger.lines if not HARMLESS.fullmatch(line)] == []
    assert status["counters"]["rx_frames"] == 0
