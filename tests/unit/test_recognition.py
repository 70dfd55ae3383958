"""What is behind a port is found out without a frame on its bus; what is unknown is refused and described."""

import contextlib
import itertools
import logging
import re
import threading
from collections.abc import Iterator

import pytest
from benches.bridge import Bench, PairPort, run_until, started, stopped
from benches.can232_host import Host, Line, adapter_for
from benches.clones import CAN232, FAMILIES, OF_ANOTHER_FAMILY, clone, effects

from bridged.adapters import firmware
from bridged.adapters.base import Confirms
from bridged.bridge.lifecycle import State
from bridged.errors import AdapterError, WrongDeviceError
from bridged.simulators.can232 import Can232

HARMLESS = {b"V\r", b"N\r", b"v\r", b"F\r", b"VV\r", b"C\r", b"V" * 50}


class Words:
    """Gives each command the answer of a table, BELL to what is not in it."""

    def __init__(self, answers: dict[bytes, bytes], otherwise: bytes = b"\a") -> None:
        self.answers = answers
        self.otherwise = otherwise
        self._line = b""
        self._output = b""

    def host_writes(self, _now: float, data: bytes) -> None:
        *lines, self._line = (self._line + data).split(b"\r")
        for line in lines:
            self._output += self.answer(line)

    def answer(self, line: bytes) -> bytes:
        flush = b"V" * 20 in line and self.answers
        return b"\a" if flush else self.answers.get(line, self.otherwise)

    def take_output(self, _now: float) -> bytes:
        output, self._output = self._output, b""
        return output


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


# slcanpty's life ends at the flush.
KINDS = [*(name for name in FAMILIES if name != "slcanpty"), *OF_ANOTHER_FAMILY, CAN232]


@pytest.mark.parametrize("is_open", [False, True], ids=["closed", "open"])
@pytest.mark.parametrize("name", KINDS)
def test_each_is_recognised_and_opened_without_an_effect(name: str, is_open: bool) -> None:
    device = clone(name, is_open=is_open)
    host = Host(device, adapter_for())
    host.start()
    assert host.adapter.identity.firmware == name.removesuffix("-fd")
    assert device.state.value == "open"
    if name != CAN232:
        assert host.written[-1] in {b"O\r", b"V\r"}  # V: where O is not answered
        own = {f"{command.text}\r".encode() for command in host.adapter.profile.open}  # type: ignore[union-attr]
        assert set(host.written) <= {*HARMLESS, b"S4\r", b"M00000000\r", b"mFFFFFFFF\r", *own}
    host.close()
    assert effects(device) == []
    assert device.state.value == ("open" if name == "slcanuino" else "closed")  # its C changes nothing


@pytest.mark.parametrize("name", KINDS)
def test_by_its_name_each_is_driven_as_without(name: str) -> None:
    found = Host(clone(name), adapter_for())
    named = Host(clone(name, is_open=True), adapter_for(firmware=name.removesuffix("-fd")))
    for host in (found, named):
        host.start()
    assert found.adapter.profile is named.adapter.profile
    assert found.adapter.identity == named.adapter.identity
    assert found.adapter.sending == named.adapter.sending
    opened = found.written[found.written.index(b"S4\r") :]
    assert named.written[named.written.index(b"S4\r") :][:3] == opened[:3]


def test_slcanpty_by_its_name() -> None:
    """Without that its life ends at the flush."""
    host = Host(clone("slcanpty"), adapter_for(firmware="slcanpty"))
    host.start()
    assert max(map(len, host.written)) < 30
    assert host.written[-1] == b"O\r"


@pytest.mark.parametrize(
    ("kind", "version", "number"),
    [
        ("canable1", "8ca5d39 https://github.com/normaldotcom/canable-fw.git", None),
        ("elmue", "2508001", "207A32585541500E"),
        ("nakakiyo", "VL2K4", None),
        ("usbtin", "V0100", None),
        ("can232", "V1324", "A123"),
    ],
)
def test_a_number_is_a_serial_number_only_where_it_is_one(
    kind: str, version: str, number: str | None
) -> None:
    host = Host(clone(kind), adapter_for())
    host.start()
    assert host.adapter.identity[:2] == (version, number)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("usbtin", "has serial number none of its own, as a USBtin has, adapter.serial_number wants NFFFF"),
        ("nakakiyo", "has serial number unknown, adapter.serial_number wants NFFFF"),
        ("can232", "has serial number A123, adapter.serial_number wants NFFFF"),
    ],
)
def test_a_wanted_serial_number_that_it_does_not_have(kind: str, text: str) -> None:
    assert text in refused(Host(clone(kind), adapter_for(serial_number="NFFFF")))


@pytest.mark.parametrize(
    ("answers", "text"),
    [
        (UCCB, "v with 'v0401', F with BELL: probably a UCCB"),
        (LATONITA, "V with 'V1013', N with 'NA123': probably an Arduino with the firmware of latonita"),
        (GDRAMOS, "v with silence, F with '00': probably a PIC 26K80 with the firmware of gdramos"),
        (CANUSB | {b"F": b"F00\r"}, "V with 'V1011', N with 'NA12F', v with BELL, F with 'F00': no firmware"),
        (CANUSB | {b"v": b"v0103\r"}, "v with 'v0103', F with BELL: no firmware that is known"),
        (CANUSB | {b"v": b""}, "v with silence, F with BELL: no firmware that is known"),
        (CANUSB | {b"F": b""}, "v with BELL, F with silence: no firmware that is known"),
        # The names of others, who would have answered the rest otherwise.
        ({b"V": b"V0100\r", b"N": b"NFFFF\r"}, "v with BELL, F with BELL: no firmware that is known"),
        ({b"V": b"V1234\r", b"N": b"N2233\r", b"F": b"F12\r"}, "F with 'F12': no firmware that is known"),
        ({b"V": b"V1234\r", b"N": b"N1234\r"}, "F with BELL: no firmware that is known"),
    ],
)
def test_what_is_unknown_or_has_no_profile(answers: dict[bytes, bytes], text: str) -> None:
    told = refused(Host(Words(answers), adapter_for()))
    assert told.startswith("the device on /dev/ttyUSB0 answers V with ")
    assert text in told
    assert "so it is not used. If you know what it is, say so by `firmware:`" in told


@pytest.mark.parametrize("number", [b"N1234\r", b"NA123\r", b"\a"], ids=repr)
@pytest.mark.parametrize(
    ("answer", "name"),
    [(b"\a", "can232"), (b"V0103\r", "can232"), (b"", "catompiler"), (b"?\r", None)],
    ids=repr,
)
def test_nonsense_tells_catompilers_library_from_a_can232(
    answer: bytes, name: str | None, number: bytes
) -> None:
    told = {b"V": b"V0103\r", b"N": number, b"VV": answer, b"C": b"\r"}
    host = Host(Words(told | dict.fromkeys((b"S4", b"O"), b"\r")), adapter_for())
    with contextlib.suppress(AdapterError):
        host.start()
    assert host.adapter.identity.firmware == name


@pytest.mark.parametrize("kind", ["usbtin", "esp32", "slcanpty"])
def test_by_the_users_word_it_is_a_can232(kind: str) -> None:
    host = Host(clone(kind), adapter_for(firmware="can232"))
    host.start()
    assert b"O\r" in host.written
    assert b"v\r" not in host.written


def test_by_the_users_word_no_canable_is_a_can232() -> None:
    assert "answers V with 'VL2K4': not a CAN232 (Vhhss)" in (
        refused_by_name(Host(clone("nakakiyo"), adapter_for(firmware="can232")))
    )


def refused_by_name(host: Host) -> str:
    with pytest.raises(WrongDeviceError) as raised:
        host.start()
    return str(raised.value)


@pytest.mark.parametrize("kind", KINDS)
def test_generic_says_only_what_every_firmware_understands(kind: str) -> None:
    device = clone(kind, is_open=True)
    host = Host(device, adapter_for(firmware="generic"))
    host.start()
    sending = host.adapter.sending
    silent = kind in {"canable1", "canable2"}
    assert sending.confirms is (Confirms.NOTHING if silent else Confirms.ALWAYS)
    assert (sending.window, sending.depth, sending.paced_bitrate) == (1, 1, 125_000)
    host.close()
    assert set(host.written) <= {b"V" * 50, b"V\r", b"C\r", b"S4\r", b"O\r"}
    assert effects(device) == []


def test_generic_takes_any_answer_to_v() -> None:
    told = {b"V": b"SLCAN 2.0\r", b"S4": b"\r", b"O": b"\r"}
    host = Host(Words(told), adapter_for(firmware="generic"))
    host.start()
    assert host.adapter.identity.version == "SLCAN 2.0"
    assert host.adapter.sync.prefix == b"SLCA"


@pytest.mark.parametrize("is_open", [False, True], ids=["closed", "open"])
def test_a_can232_is_none_of_them(is_open: bool) -> None:
    device = clone("can232", is_open=is_open)
    device.eeprom.auto_poll = True
    host = Host(device, adapter_for())
    host.start()
    told = host.written[host.written.index(b"V\r") :]
    assert told == [
        *(b"V\r", b"V\r", b"N\r", b"v\r", b"C\r", b"F\r", b"VV\r"),
        *(b"S4\r", b"M00000000\r", b"mFFFFFFFF\r", b"O\r", b"A\r"),
    ]


def test_a_canusb_is_none_of_them() -> None:
    host = Host(Words(CANUSB, otherwise=b"\a"), adapter_for())
    with pytest.raises(AdapterError, match="to set the bit rate"):  # that is how far the table goes
        host.start()


class Wrapped:
    """A CAN232 that is open, to change what goes in and out."""

    def __init__(self) -> None:
        self.device = clone(CAN232, is_open=True)

    def host_writes(self, now: float, data: bytes) -> None:
        self.device.host_writes(now, data)

    def take_output(self, now: float) -> bytes:
        output: bytes = self.device.take_output(now)
        return output


def test_an_open_can232_that_did_not_hear_the_first_c() -> None:
    class Deaf(Wrapped):
        heard = 0

        def host_writes(self, now: float, data: bytes) -> None:
            self.heard += data == b"C\r"
            if data != b"C\r" or self.heard > 1:
                super().host_writes(now, data)

    host = Host(Deaf(), adapter_for())
    host.start()
    assert b"O\r" in host.written


def test_the_end_of_a_line_that_began_before_us_is_no_answer() -> None:
    class Talking(Wrapped):
        rest = b"1122\r"

        def take_output(self, now: float) -> bytes:
            rest = self.rest if now > 0.06 else b""
            self.rest = self.rest[len(rest) :]
            return super().take_output(now) + rest

    host = Host(Talking(), adapter_for())
    host.start()
    assert b"O\r" in host.written


@pytest.mark.parametrize("product", ["CANtact dev", "CANtact b12"])
def test_not_a_byte_for_a_cantact(product: str) -> None:
    for options in ({}, {"firmware": "can232"}):
        device = clone("cantact", is_open=True)
        host = Host(device, adapter_for(**options))
        assert f"calls itself '{product}'" in refused(host, product)
        assert (host.written, host.adapter.last_words, device.effects) == ([], b"", [])


def test_another_product_is_asked() -> None:
    host = Host(clone("can232"), adapter_for())
    host.start(product="CANable 8ca5d39 https://github.com/normaldotcom/cantact-fw.git")
    assert host.adapter.identity.version == "V1324"


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (b"", "no answer to V on /dev/ttyUSB0 at 57600 Bd: is the adapter powered"),
        (b"\a", "refuses every command, V too"),
        (b"\r", "answers V with an empty line: not a CAN232"),
        (b"\x00\xff\x80", "only noise answers V on /dev/ttyUSB0 at 57600 Bd"),
        (b"\xffUnknown command\r", "answers V with 'Unknown command': no firmware that is known"),
        (b"UNKNOWN\rOK\r\a", "answers V with 'UNKNOWN': no firmware that is known"),
        (b"V12\r", "answers V with 'V12': no firmware that is known"),
        (b"x" * 250 + b"\r", f"answers V with '{'x' * 120}…': no firmware that is known"),
    ],
)
def test_what_came_instead_of_a_version(answer: bytes, text: str) -> None:
    host = Host(Words({}, otherwise=answer), adapter_for())
    with pytest.raises(AdapterError, match=re.escape(text)):
        host.start()


def test_noise_that_looks_like_text_now_and_then_is_no_answer() -> None:
    noise = itertools.cycle([b"\x80\xffab\r", b"\xfe\x81", b"\x90q\r", b"\x80q\r"])

    class Noise(Words):
        def answer(self, _line: bytes) -> bytes:
            return next(noise)

    with pytest.raises(AdapterError, match="only noise answers V"):
        Host(Noise({}), adapter_for()).start()


@contextlib.contextmanager
def behind_a_port(bench: Bench, device: Line) -> Iterator[None]:
    """The device answers in a thread; the bridge must have ended at the end."""
    port = PairPort()
    bench.open_port = lambda *_args: port

    def answer() -> None:
        now = 0.0
        while data := port.far.recv(4096):
            now += 0.1
            device.host_writes(now, data)
            port.far.sendall(device.take_output(now))

    thread = threading.Thread(target=answer)
    thread.start()
    yield
    thread.join()
    port.far.close()


def test_a_long_answer_with_tabs_reaches_the_log(bench: Bench) -> None:
    device = clone("elmue")
    device.version = device.version.replace(b"+Board", b"Other board")  # as long, but not known
    assert len(device.version) > 180
    with behind_a_port(bench, device):
        bridge = started(bench.bridge(), State.FAULT)
        reason = bridge.reason
        stopped(bridge)
    assert r"answers V with 'Other board: MksMakerbase\tMCU: STM32G431\t" in reason


@pytest.mark.parametrize("kind", ["canable1", "weact", "elmue"])
def test_one_without_flags_is_asked_for_its_version_while_it_runs(
    bench: Bench, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    device = clone(kind)
    with behind_a_port(bench, device):
        bridge = started(bench.bridge())
        asked = device.counters.commands["V"]
        run_until(bridge, lambda: device.counters.commands["V"] >= asked + 6)
        status = stopped(bridge)
    profile = firmware.load(status["adapter"]["firmware"])
    assert bridge.adapter.profile is profile  # type: ignore[attr-defined]
    assert status["adapter"]["sent_means"] in caplog.messages
    assert [text for text in caplog.messages if "of this adapter: " in text] == [
        f"of this adapter: {text}" for text in profile.cautions
    ]
    assert status["counters"]["reconnects"] == 0
    assert status["channel_open"] is False
    assert (device.state.value, effects(device)) == ("closed", [])


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
