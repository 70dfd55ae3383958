"""What answers V like a CAN232 and is none is refused before it is told anything; what was seen is said."""

import re
import threading

import pytest
from benches.bridge import Bench, PairPort, started, stopped
from benches.can232_host import Host, adapter_for
from benches.clone_parsers import (
    OTHERS,
    Canable1,
    Canable2,
    Cantact,
    Cato,
    Elmue,
    Esp32,
    Firmware,
    Naka,
    NakaFd,
    Reference,
    Slcanpty,
    Uino,
    Usbtin,
    Weact,
)

from bridged.bridge.lifecycle import State
from bridged.errors import AdapterError, WrongDeviceError
from bridged.simulators.can232 import Can232

HARMLESS = {b"V\r", b"N\r", b"v\r", b"F\r", b"C\r", b"V" * 50}
REMEDY = "`firmware: can232` in section adapter"


class Words(Firmware):
    """Gives each command the answer of a table, BELL to what is not in it."""

    def __init__(self, answers: dict[bytes, bytes], otherwise: bytes = b"\a") -> None:
        super().__init__()
        self.answers = answers
        self.otherwise = otherwise

    def _end_line(self) -> None:
        line = bytes(self._line)
        self._line.clear()
        flush = b"VV" in line and self.answers
        self._output += b"\a" if flush else self.answers.get(line, self.otherwise)


# Not driven, but described: what they answer.
UCCB = {b"V": b"V0101\r", b"v": b"v0401\r", b"N": b"N78563412\r"}
LATONITA = {b"V": b"V1013\r", b"N": b"NA123\r", b"C": b"\r"}
GDRAMOS = {b"V": b"V1020\r", b"N": b"N0001\r", b"F": b"00\r", b"C": b"\r", b"v": b""}
CANUSB = {b"V": b"V1011\r", b"N": b"NA12F\r"}


def refused(host: Host, product: str | None = None) -> str:
    """Why; the closing, which follows, is part of the check that nothing else was said to the device."""
    with pytest.raises(WrongDeviceError) as raised:
        host.start(product=product)
    host.close()
    assert set(host.written) <= HARMLESS
    return str(raised.value)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (
            Canable1,
            "V with '8ca5d39 https://github.com/normaldotcom/cantact-fw.git': probably a CANable with slcan",
        ),
        (
            Canable2,
            "V with 'b158aa7 https://github.com/normaldotcom/canable2.git': probably a CANable with slcan",
        ),
        (Naka, "V with 'VL2K4': probably a CANable with the firmware of Nakakiyo092, not a CAN232"),
        (NakaFd, "V with 'VW1K2': probably a USB2CANFDV1 with the firmware of Nakakiyo092, not a CAN232"),
        (Weact, "V with 'WeAct Studio V1.0.0.8_20250401': probably a WeAct USB2CANFDV1, not a CAN232"),
        (Elmue, r"V with '+Board: MksMakerbase\tMCU: STM32G431\tDevID: 1128\t"),
        (Usbtin, "V with 'V0100' and N with 'NFFFF': probably a USBtin, not a CAN232"),
        (Esp32, "V with 'V1234' and N with 'N2233': probably an ESP32 with esp32-slcan, not a CAN232"),
        (Uino, "V with 'V1234' and N with 'N1234': probably an Arduino with slcanuino, not a CAN232"),
        (Slcanpty, "V with 'V1013' and N with 'N4242': probably slcanpty, not a CAN232"),
    ],
)
@pytest.mark.parametrize("is_open", [False, True], ids=["closed", "open"])
def test_each_is_named(kind: type[Firmware], text: str, is_open: bool) -> None:
    device = kind(is_open=is_open)
    told = refused(Host(device, adapter_for()))
    assert f"the device on /dev/ttyUSB0 answers {text}" in told
    assert (REMEDY in told) == bool(kind.serial_number)  # the others were refused before, too
    assert device.effects == []


@pytest.mark.parametrize(
    ("answers", "text"),
    [
        (UCCB, "v with 'v0401': probably a UCCB, not a CAN232"),
        (
            LATONITA,
            "V with 'V1013' and N with 'NA123': probably an Arduino with slcan firmware, not a CAN232",
        ),
        (GDRAMOS, "F with '00' while its channel is closed: not a CAN232"),
        (CANUSB | {b"F": b"F00\r"}, "F with 'F00' while its channel is closed: not a CAN232"),
        (CANUSB | {b"v": b"v0103\r"}, "v with 'v0103': probably a USBtin, not a CAN232"),
    ],
)
def test_what_gives_itself_away_later(answers: dict[bytes, bytes], text: str) -> None:
    told = refused(Host(Words(answers), adapter_for()))
    assert told.startswith(f"the device on /dev/ttyUSB0 answers {text}, so it is not used; {REMEDY}")


def test_every_model_but_one_is_refused() -> None:
    """What cannot be told from a CAN232 of an old version: README says so."""
    passed = set()
    for kind in OTHERS:
        host = Host(kind(), adapter_for())
        try:
            host.start()
        except WrongDeviceError:
            continue
        passed.add(kind)
    assert passed == {Cato}


@pytest.mark.parametrize("kind", [Usbtin, Esp32, Slcanpty])
def test_by_the_users_word_it_is_a_can232(kind: type[Firmware]) -> None:
    host = Host(kind(), adapter_for(firmware="can232"))
    host.start()
    assert b"O\r" in host.written
    assert b"v\r" not in host.written


@pytest.mark.parametrize("is_open", [False, True], ids=["closed", "open"])
def test_a_can232_is_none_of_them(is_open: bool) -> None:
    device = Reference(is_open=is_open)
    device.device.eeprom.auto_poll = True
    host = Host(device, adapter_for())
    host.start()
    told = host.written[host.written.index(b"V\r") :]
    assert told == [
        *(b"V\r", b"V\r", b"N\r", b"v\r", b"C\r", b"F\r"),
        *(b"S4\r", b"M00000000\r", b"mFFFFFFFF\r", b"O\r", b"A\r"),
    ]


def test_a_canusb_is_none_of_them() -> None:
    host = Host(Words(CANUSB, otherwise=b"\a"), adapter_for())
    with pytest.raises(AdapterError, match="to set the bit rate"):  # that is how far the table goes
        host.start()


def test_an_open_can232_that_did_not_hear_the_first_c() -> None:
    class Deaf(Reference):
        heard = 0

        def host_writes(self, now: float, data: bytes) -> None:
            self.heard += data == b"C\r"
            if data != b"C\r" or self.heard > 1:
                super().host_writes(now, data)

    host = Host(Deaf(is_open=True), adapter_for())
    host.start()
    assert b"O\r" in host.written


def test_the_end_of_a_line_that_began_before_us_is_no_answer() -> None:
    class Talking(Reference):
        rest = b"1122\r"

        def take_output(self, now: float) -> bytes:
            rest = self.rest if now > 0.06 else b""
            self.rest = self.rest[len(rest) :]
            return super().take_output(now) + rest

    host = Host(Talking(is_open=True), adapter_for())
    host.start()
    assert b"O\r" in host.written


@pytest.mark.parametrize("product", ["CANtact dev", "CANtact b12"])
def test_not_a_byte_for_a_cantact(product: str) -> None:
    for options in ({}, {"firmware": "can232"}):
        device = Cantact(is_open=True)
        host = Host(device, adapter_for(**options))
        assert f"calls itself '{product}'" in refused(host, product)
        assert (host.written, host.adapter.last_words, device.effects) == ([], b"", [])


def test_another_product_is_asked() -> None:
    host = Host(Reference(), adapter_for())
    host.start(product="CANable 8ca5d39 https://github.com/normaldotcom/cantact-fw.git")
    assert host.adapter.identity.version == "V1324"


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (b"", "no answer to V on /dev/ttyUSB0 at 57600 Bd: is the adapter powered"),
        (b"\a", "refuses every command, V too"),
        (b"\r", "answers V with an empty line: not a CAN232"),
        (b"\x00\xff\x80", "only noise answers V on /dev/ttyUSB0 at 57600 Bd"),
        (b"\xffUnknown command\r", "answers V with 'Unknown command': not a CAN232"),
        (b"UNKNOWN\rOK\r\a", "answers V with 'UNKNOWN': not a CAN232"),
        (b"V12\r", "answers V with 'V12': not a CAN232"),
        (b"x" * 250 + b"\r", f"answers V with '{'x' * 120}…': not a CAN232"),
    ],
)
def test_what_came_instead_of_a_version(answer: bytes, text: str) -> None:
    host = Host(Words({}, otherwise=answer), adapter_for())
    with pytest.raises(AdapterError, match=re.escape(text)):
        host.start()


def test_noise_that_looks_like_text_now_and_then_is_no_answer() -> None:
    noise = iter([b"\x80\xffab\r", b"\xfe\x81", b"\x90q\r", b"\x80q\r"])

    class Noise(Words):
        def _end_line(self) -> None:
            self._output += next(noise)

    with pytest.raises(AdapterError, match="only noise answers V"):
        Host(Noise({}), adapter_for()).start()


def test_a_long_answer_with_tabs_reaches_the_log(
    bench: Bench,
) -> None:
    port = PairPort()
    bench.open_port = lambda *_args: port
    device = Elmue()

    def answer() -> None:
        now = 0.0
        while data := port.far.recv(4096):
            now += 0.1
            device.host_writes(now, data)
            port.far.sendall(device.take_output(now))

    thread = threading.Thread(target=answer)
    thread.start()
    bridge = started(bench.bridge(), State.FAULT)
    reason = bridge.reason
    stopped(bridge)
    thread.join()
    port.far.close()
    assert len(Elmue.version) > 180
    assert r"answers V with '+Board: MksMakerbase\tMCU: STM32G431\t" in reason
    assert "probably a CANable with the firmware of Elmue" in reason


def test_a_cantact_is_refused_by_the_bridge_without_a_byte(
    bench: Bench,
) -> None:
    port = PairPort()
    port.product = "CANtact dev"
    bench.open_port = lambda *_args: port
    bridge = started(bench.bridge(), State.FAULT)
    reason = bridge.reason
    stopped(bridge)
    with port.far:
        assert port.far.recv(100) == b""
    assert "calls itself 'CANtact dev'" in reason


def test_the_same_can232_is_taken_by_its_name_or_without(bench: Bench) -> None:
    for options in ({}, {"firmware": "can232"}):
        device = Can232(0.0)
        bench.plug_in(device)
        bridge = started(bench.bridge(**options))
        stopped(bridge)
        bench.pull_out()
