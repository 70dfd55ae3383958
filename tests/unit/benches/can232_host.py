"""A host that performs the steps of a CAN232's adapter in virtual time, as the bridge and the relay do."""

from collections.abc import Iterable
from typing import Any, Protocol

from bridged import _relay
from bridged.adapters.base import Answer, Exchange, Reply, Steps
from bridged.adapters.can232 import Can232, Can232Config
from bridged.can import BitTiming
from bridged.errors import AdapterError
from bridged.settings import ChannelConfig

KINDS = {"ok": Reply.OK, "refused": Reply.REFUSED, "text": Reply.TEXT}


class Line(Protocol):
    """What a Host asks of a device."""

    def host_writes(self, now: float, data: bytes) -> None: ...
    def take_output(self, now: float) -> bytes: ...


class NoMemory:
    """Nothing is known of any adapter's EEPROM."""

    def recall(self, _serial_number: str, _setting: str) -> int | None:
        return None

    def remember(self, _serial_number: str, _setting: str, _value: int) -> None:
        pass


def adapter_for(channel: ChannelConfig | None = None, **options: Any) -> Can232:
    config = Can232Config(type="can232", port="/dev/ttyUSB0", **options)
    return Can232(config, channel or ChannelConfig(timing=BitTiming(125_000)), NoMemory())


class Host:
    """`written`: each write by itself; `now` is its clock."""

    def __init__(self, device: Line, adapter: Can232) -> None:
        self.device = device
        self.adapter = adapter
        self.now = 0.0
        self.written: list[bytes] = []

    def start(self, steps_wanted: int = 1000, product: str | None = None) -> None:
        self.perform(self.adapter.init_steps(None, product), steps_wanted)

    def close(self, *, drain: bool = False) -> None:
        self.perform(self.adapter.close_steps(drain))

    def perform(self, steps: Steps, wanted: int = 1000) -> None:
        """AdapterError for an answer that is not accepted, too; `wanted` steps, no more."""
        answer = None
        for _ in range(min(wanted, 200)):
            try:
                exchange = steps.send(answer) if answer else next(steps)
            except StopIteration:
                return
            answer = self._ask(exchange)
            assert (answer.reply in exchange.accept) != (answer.reply in exchange.reject), exchange
            if answer.reply in exchange.reject:
                raise AdapterError(f"{answer.reply.name} to the request to {exchange.purpose}")
        assert wanted < 200, "it asks for ever"

    def _ask(self, exchange: Exchange) -> Answer:
        for _ in self._unasked(self._messages()):
            pass
        if exchange.request:
            self.written.append(exchange.request)
            self.device.host_writes(self.now, exchange.request)
        wanted = {*exchange.accept, *exchange.reject}
        messages = iter(self._messages())
        for reply, text in self._unasked(messages, exchange.prefix):
            if reply in wanted:
                for _ in self._unasked(messages):
                    pass
                return Answer(reply, text)
        self.now += exchange.timeout_s
        return Answer(Reply.NONE)

    def _messages(self) -> list[tuple[str, bytes, int]]:
        return _relay.decode("can232", [self.device.take_output(self.now)])

    def _unasked(
        self, messages: Iterable[tuple[str, bytes, int]], prefix: bytes = b""
    ) -> Iterable[tuple[Reply, bytes]]:
        """Those that can be an answer; the others are told to the adapter."""
        for kind, text, _ in messages:
            if kind == "text" and not (prefix and text.startswith(prefix)):
                self.adapter.saw_text(text)
            elif kind == "skipped":
                self.adapter.saw_noise(text)
            elif kind in KINDS:
                yield KINDS[kind], text if kind == "text" else b""
