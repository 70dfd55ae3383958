"""What the tests of the USB2CAN's adapter share: a host that performs its steps in virtual time."""

from collections.abc import Callable
from typing import Any, Protocol

import pytest

from bridged import _relay
from bridged.adapters.base import Answer, Reply, Steps
from bridged.adapters.usb2can import Usb2can, Usb2canConfig
from bridged.can import BitTiming
from bridged.errors import AdapterError
from bridged.settings import ChannelConfig
from bridged.simulators.sja1000 import MOD
from bridged.simulators.usb2can import State
from bridged.simulators.usb2can import Usb2can as Device

QUERIES = ("GET_MODE", "FW_VERSION", "COMMAND 128", "READ_REG", "READ_TEC", "READ_REC", "READ_RST")


class Line(Protocol):
    """What a Host asks of a device."""

    def host_writes(self, now: float, data: bytes) -> None: ...
    def take_output(self, now: float) -> bytes: ...
    def next_deadline(self) -> float: ...


class Parrot:
    """Another device: says the same to everything."""

    def __init__(self, words: bytes) -> None:
        self._words = words
        self._output = b""

    def host_writes(self, _now: float, _data: bytes) -> None:
        self._output += self._words

    def take_output(self, _now: float) -> bytes:
        output, self._output = self._output, b""
        return output

    def next_deadline(self) -> float:
        return float("inf")


class Host:
    """Performs the steps of an adapter as bridge.py and the relay do; `now` is its clock."""

    def __init__(self, device: Line, adapter: Usb2can) -> None:
        self.device = device
        self.adapter = adapter
        self.now = 0.0
        self.asked = 0  # exchanges
        self.before_each: Callable[[int], None] = lambda _number: None
        self._heard: list[bytes] = []
        self._decoded = 0  # messages in them

    def start(self, steps_wanted: int = 1000) -> None:
        self.perform(self.adapter.init_steps("A6008isP"), steps_wanted)

    def close(self) -> None:
        self.perform(self.adapter.close_steps(drain=True))

    def perform(self, steps: Steps, wanted: int = 1000) -> None:
        """AdapterError for an answer that is not accepted, too; `wanted` steps, no more."""
        self.asked = 0
        answer = None
        while self.asked < wanted:
            try:
                exchange = steps.send(answer) if answer else next(steps)
            except StopIteration:
                return
            assert self.asked < 200, "it asks for ever"
            self.before_each(self.asked)
            self.asked += 1
            assert len(exchange.request) <= 64  # see relay.h
            assert len(exchange.prefix) <= 4
            answer = self.ask(exchange.request, exchange.prefix, exchange.timeout_s)
            assert (answer.reply in exchange.accept) != (answer.reply in exchange.reject)
            if answer.reply in exchange.reject:
                raise AdapterError(f"did not answer the request to {exchange.purpose}")

    def ask(self, request: bytes, prefix: bytes, timeout_s: float) -> Answer:
        until = self.now + timeout_s
        self.device.host_writes(self.now, request)
        while True:
            answers = [text for text in self._texts() if prefix and text.startswith(prefix)]
            if answers:
                return Answer(Reply.TEXT, answers[0])
            if self.device.next_deadline() > until:
                self.now = until
                return Answer(Reply.NONE)
            self.now = max(self.now, self.device.next_deadline())

    def _texts(self) -> list[bytes]:
        output = self.device.take_output(self.now)
        if not output:
            return []
        self._heard.append(output)
        messages = _relay.decode("usb2can", self._heard)[self._decoded :]
        self._decoded += len(messages)
        if messages and {kind for kind, _, _ in messages} == {"skipped"}:
            self.adapter.saw_noise(output)
        return [text for kind, text, _ in messages if kind == "text"]


def channel(timing: BitTiming | None = None, **options: Any) -> ChannelConfig:
    return ChannelConfig(timing=timing or BitTiming(125_000), **options)


def adapter_for(channel_: ChannelConfig | None = None, **options: Any) -> Usb2can:
    config = Usb2canConfig(type="usb2can", port="/dev/ttyUSB0", **options)
    return Usb2can(config, channel_ or channel())


def started(device: Device, adapter: Usb2can | None = None) -> Host:
    host = Host(device, adapter or adapter_for())
    host.start()
    return host


def settings(device: Device) -> list[str]:
    """What it was told, without what it was asked."""
    return [line for line in device.record if not line.startswith(QUERIES)]


def assert_open(device: Device, mod: int = 0x00, bitrate: float = 125_000) -> None:
    chip = device.chip
    assert device.state is State.NORMAL
    assert chip.read(MOD) == mod
    assert chip.bitrate == pytest.approx(bitrate, rel=1e-5)
    assert (device.critical, device.ready) == (15, 7)


def assert_closed(device: Device) -> None:
    assert device.state is State.CONFIG
    assert device.chip.in_reset
