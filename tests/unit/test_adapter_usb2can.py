"""The USB2CAN's adapter without I/O: what it says to the simulated device, in virtual time."""

import logging
from collections.abc import Iterator

import pytest
from benches.usb2can_host import (
    Host,
    Parrot,
    adapter_for,
    assert_closed,
    assert_open,
    channel,
    settings,
    started,
)
from benches.usb2can_words import LOOPBACK, OPEN, SETUP, WRITTEN, ask, opened

from bridged import _relay
from bridged.adapters.base import Answer, Happened, Observation, Reply
from bridged.adapters.usb2can import BUS_OFF, ERROR, GET_MODE, Usb2can
from bridged.can import AcceptanceFilter, BitTiming, BusState, bit_timing
from bridged.errors import AdapterError, WrongDeviceError
from bridged.simulators.sja1000 import MOD, Frame
from bridged.simulators.usb2can import Usb2can as Device

BITRATES = (10_000, 20_000, 50_000, 83_333, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
PAIRS = [(critical, ready) for critical in range(1, 19) for ready in range(critical)]
LISTEN_ONLY, SINGLE = 0x02, 0x08  # bits of MOD
MODES = {"boot": "", "config": "0F0200", "normal": OPEN, "loopback": SETUP + LOOPBACK}

MANUAL_START = [
    "CONFIG_MODE", "WRITE_REG 0 0x01", "WRITE_REG 31 0xC0",
    "WRITE_REG 16 0x00", "WRITE_REG 17 0x00", "WRITE_REG 18 0x00", "WRITE_REG 19 0x00",
    "WRITE_REG 20 0xFF", "WRITE_REG 21 0xFF", "WRITE_REG 22 0xFF", "WRITE_REG 23 0xFF",
    "WRITE_REG 8 0xDA", "WRITE_REG 4 0x03", "WRITE_REG 6 0x03", "WRITE_REG 7 0x1C",
    "COMMAND 0 15", "COMMAND 1 7", "COMMAND 2", "COMMAND 3", "NORMAL_MODE", "WRITE_REG 0 0x00",
]  # fmt: skip
MANUAL_END = ["CONFIG_MODE", "WRITE_REG 0 0x01"]


@pytest.fixture(params=[0.0, 0.002], ids=["at-once", "slow"])
def device(request: pytest.FixtureRequest) -> Iterator[Device]:
    """Power has just come; at the end it has nothing to complain of."""
    made = Device(processing_s=request.param)
    yield made
    assert made.violations == []


# --- what the manual says, literally ----------------------------------------------------------


def test_it_starts_with_the_ten_steps_and_ends_with_the_two(device: Device) -> None:
    host = started(device)
    assert settings(device) == MANUAL_START
    assert_open(device)
    host.close()
    assert settings(device) == MANUAL_START + MANUAL_END
    assert_closed(device)
    assert device.violations == []


def test_a_second_session_is_as_the_first(device: Device) -> None:
    host = started(device)
    host.close()
    host.start()
    assert settings(device) == MANUAL_START + MANUAL_END + MANUAL_START
    assert device.violations == []


def test_the_last_words_close_it_too(device: Device) -> None:
    host = started(device)
    device.host_writes(host.now, host.adapter.last_words)
    device.advance(host.now + 1)
    assert settings(device) == MANUAL_START + MANUAL_END


@pytest.mark.parametrize("bitrate", BITRATES)
def test_bit_rates(device: Device, bitrate: int) -> None:
    registers = bit_timing(bitrate) if bitrate == 83_333 else None
    started(device, adapter_for(channel(BitTiming(bitrate, registers))))
    assert_open(device, bitrate=bitrate)


def test_btr0_and_btr1(device: Device) -> None:
    started(device, adapter_for(channel(BitTiming.from_registers(0x40, 0x1C))))
    assert {"WRITE_REG 6 0x40", "WRITE_REG 7 0x1C"} < set(device.record)
    assert_open(device, bitrate=500_000)


@pytest.mark.parametrize("listen_only", [False, True])
@pytest.mark.parametrize("single", [False, True])
def test_filter_and_listen_only(device: Device, listen_only: bool, single: bool) -> None:
    acceptance = AcceptanceFilter(0x12345678, 0x9ABCDEF0, single)
    started(device, adapter_for(channel(listen_only=listen_only, acceptance=acceptance)))
    assert_open(device, LISTEN_ONLY * listen_only | SINGLE * single)
    assert device.chip.code == bytes.fromhex("12345678")
    assert device.chip.mask == bytes.fromhex("9ABCDEF0")


def test_a_listener_is_one_before_it_can_be_on_the_bus(device: Device) -> None:
    started(device, adapter_for(channel(listen_only=True)))
    written = [line for line in settings(device) if line.startswith(("WRITE_REG 0", "NORMAL"))]
    assert written == ["WRITE_REG 0 0x01", "WRITE_REG 0 0x03", "NORMAL_MODE", "WRITE_REG 0 0x02"]


def test_a_device_that_does_not_listen_only_is_refused() -> None:
    class Talker(Device):
        def _write(self, address: int, value: int) -> None:
            super()._write(address, value & ~LISTEN_ONLY if address == MOD else value)

    device = Talker()
    host = Host(device, adapter_for(channel(listen_only=True)))
    with pytest.raises(WrongDeviceError, match=r"does not keep its listen-only .*: MOD is 0x00, not 0x02"):
        host.start()
    host.close()
    assert_closed(device)
    assert device.violations == []


# --- limits -----------------------------------------------------------------------------------


@pytest.mark.parametrize("answers_get", [True, False])
@pytest.mark.parametrize("wanted", [(15, 7), (1, 0), (18, 17)])
def test_ready_is_below_critical_whatever_they_were(wanted: tuple[int, int], answers_get: bool) -> None:
    for before in PAIRS:
        device = Device(answers_get=answers_get)
        for critical, ready in (before, wanted):
            started(device, adapter_for(critical_limit=critical, ready_limit=ready))
            assert (device.critical, device.ready) == (critical, ready)
        assert device.violations == []


@pytest.mark.parametrize("before", [(15, 7), (1, 0), (18, 17)])
def test_every_pair_of_limits(before: tuple[int, int]) -> None:
    device = Device()
    for critical, ready in PAIRS:
        started(device, adapter_for(critical_limit=before[0], ready_limit=before[1]))
        started(device, adapter_for(critical_limit=critical, ready_limit=ready))
        assert (device.critical, device.ready) == (critical, ready)
    assert device.violations == []


@pytest.mark.parametrize(
    ("options", "question", "prefix"),
    [
        ({}, "0F 20 01 80", "20 05 80"),
        ({"get_length_4": True}, "0F 20 01 80", "20 04"),
        ({"answers_get": False}, "0F 10 01 00", "10 02 00"),
    ],
)
def test_what_asks_how_full_it_is(options: dict[str, bool], question: str, prefix: str) -> None:
    device = Device(**options)  # type: ignore[arg-type]
    flow = started(device).adapter.flow
    assert flow
    assert (flow.request, flow.prefix) == (bytes.fromhex(question), bytes.fromhex(prefix))
    assert (flow.capacity, flow.critical, flow.ready) == (18, 15, 7)
    assert_open(device)
    assert device.violations == []


@pytest.mark.parametrize("answer", ["80 07 0F 00 00", "80 0F 07 01 00", "80 00 00 0F 07", "0F 07 00 00 00"])
def test_parameters_that_are_not_what_was_set_are_not_believed(answer: str) -> None:
    class Odd(Device):
        def _get(self) -> bytes:
            return bytes.fromhex(answer)

    device = Odd()
    host = started(device)
    flow = host.adapter.flow
    assert flow
    assert flow.request == bytes.fromhex("0F 10 01 00")
    assert_open(device)
    begin = host.now
    host.close()  # nor are they for the frames that it has to send yet
    assert (host.now - begin < 0.01, host.adapter.discarded) == (True, 0)
    assert device.violations == []


# --- whatever it was doing --------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_from_every_mode(device: Device, mode: str) -> None:
    ask(device, MODES[mode])
    device.advance(1.0)
    host = Host(device, adapter_for())
    host.now = 1.0
    host.start()
    assert_open(device)
    assert settings(device)[-len(MANUAL_START) :] == MANUAL_START


HALVES = [
    *(bytes.fromhex("0F 40 0D 88 00 00 0F 78 0F 06 00 0F 02 00 0F 06")[:n] for n in range(1, 16)),
    *(bytes.fromhex("0F 10 01")[:n] for n in range(2, 4)),
    *(bytes.fromhex("0F 12 02 00")[:n] for n in range(2, 5)),
    *(bytes.fromhex("0F 20 02 00")[:n] for n in range(2, 5)),
    bytes.fromhex("0F 40 10"),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("half", HALVES, ids=lambda half: half.hex())
def test_half_a_message_of_another_program_costs_one_message(mode: str, half: bytes) -> None:
    device = Device()
    ask(device, MODES[mode])
    device.host_writes(0.0, half)
    assert device.violations == []
    host = started(device)
    assert_open(device)
    # What it makes of that half and the beginning of ours was none of our words.
    assert len(device.violations) <= 1
    assert host.now < 1.5
    host.close()
    assert_closed(device)


@pytest.mark.parametrize("junk", ["", "FF", "FFFF", "0F", "0F41", "0F0601", "0F0FFF", "00" * 64, "0F410B08"])
@pytest.mark.parametrize("quirks", [True, False])
def test_junk_at_power_on(junk: str, quirks: bool) -> None:
    device = Device(junk=bytes.fromhex(junk), quirks=quirks)
    started(device)
    assert_open(device)
    assert device.violations == []


@pytest.mark.parametrize("series", "0123456")
def test_a_device_that_receives_and_reports_meanwhile(series: str) -> None:
    device = Device(version=f"HW0003FW{series}016")
    ask(device, OPEN)
    host = Host(device, adapter_for())

    def bus(number: int) -> None:
        for n in range(20):
            device.bus_frame(host.now, Frame(n, n % 2 > 0, False, 8, b"\x0f\x06\x01\x02\x0f\x12\x01\x00"))
        device.overrun(host.now)
        device.value_2_burst(host.now, 3)
        device.set_error_counters(host.now, 100 * (number % 2), 0)

    host.before_each = bus
    for _ in range(2):
        host.now += 1.5  # for TIMESTAMP
        host.start()
        assert_open(device)
        host.close()
        assert_closed(device)
    assert host.adapter.identity.version == f"HW0003FW{series}016"
    assert host.adapter.identity.serial_number == "A6008isP"
    assert device.violations == []


def test_firmware_that_loads_the_bus_is_remarked(device: Device, caplog: pytest.LogCaptureFixture) -> None:
    started(device)
    assert not [r for r in caplog.records if r.levelno >= logging.WARNING]
    loader = Device(version="HW0003FW2016")
    started(loader)
    assert "loads the bus for tests (HW0003FW2016)" in caplog.text
    assert loader.violations == []


# --- what is no USB2CAN -----------------------------------------------------------------------


def refused(device: Device, adapter: Usb2can | None = None) -> str:
    """Why; and it is closed all the same."""
    host = Host(device, adapter or adapter_for())
    with pytest.raises(WrongDeviceError) as caught:
        host.start()
    host.close()
    assert_closed(device)
    assert device.violations == []
    return str(caught.value)


def test_fms_firmware_is_refused() -> None:
    assert "FMS firmware (HW0003FW7016)" in refused(Device(version="HW0003FW7016"))


@pytest.mark.parametrize("version", ["HW0003XX0016", "            ", "TRIPLE V1.00"])
def test_what_has_another_kind_of_version_is_refused(version: str) -> None:
    device = Device()
    object.__setattr__(device.variant, "version", version)
    assert f"FW_VERSION with '{version}'" in refused(device)


@pytest.mark.parametrize(
    ("serial_number", "words"),
    [("A600XXXX", "has serial number A600XXXX"), (None, "has no serial number that can be read")],
)
def test_a_wrong_serial_number_is_refused_before_a_word_is_said(
    serial_number: str | None, words: str
) -> None:
    device = Device()
    host = Host(device, adapter_for(serial_number="A6008isP"))
    with pytest.raises(WrongDeviceError, match=f"{words}, adapter.serial_number wants A6008isP"):
        host.perform(host.adapter.init_steps(serial_number))
    assert (host.asked, device.record) == (0, [])
    host.start()
    assert_open(device)
    assert device.violations == []


@pytest.mark.parametrize("words", ["0F01020304EF", "0F21054142431F0FEF", "0F80EF" * 3])
def test_a_triple_is_refused(words: str) -> None:
    host = Host(Parrot(bytes.fromhex(words)), adapter_for())
    with pytest.raises(WrongDeviceError, match="is a CANLAB Triple"):
        host.start()
    host.close()


@pytest.mark.parametrize(
    ("words", "heard"), [(b"", "/dev/ttyUSB0: is it"), (b"\a", "sent 5 bytes"), (b"V1011\r", "sent 30 bytes")]
)
def test_what_does_not_answer_is_an_error(words: bytes, heard: str) -> None:
    host = Host(Parrot(words), adapter_for())
    with pytest.raises(AdapterError, match="no answer to CONFIG_MODE and GET_MODE") as caught:
        host.start()
    assert not isinstance(caught.value, WrongDeviceError)
    assert heard in str(caught.value)
    assert host.now == pytest.approx(1.5)
    host.close()
    assert host.now < 2.5


def test_noise_is_kept_up_to_a_bound_and_from_this_start_only() -> None:
    host = Host(Parrot(bytes.fromhex("0F01020304EF")), adapter_for())
    with pytest.raises(WrongDeviceError):
        host.start()
    host.device = Parrot(b"\xff" * 100)
    with pytest.raises(AdapterError, match="it sent 256 bytes") as caught:
        host.start()
    assert not isinstance(caught.value, WrongDeviceError)


# --- lost answers, stops ----------------------------------------------------------------------


@pytest.mark.parametrize("listen_only", [False, True])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_lost_answers_do_no_harm(listen_only: bool, count: int) -> None:
    mod = LISTEN_ONLY * listen_only
    number_of_steps = started(Device(), adapter_for(channel(listen_only=listen_only))).asked
    for lost in range(number_of_steps):
        device = Device()
        host = Host(device, adapter_for(channel(listen_only=listen_only)))

        def lose(number: int, device: Device = device, lost: int = lost) -> None:
            device.drop_answers = count if number == lost else device.drop_answers

        host.before_each = lose
        try:
            host.start()
        except AdapterError as error:
            assert not isinstance(error, WrongDeviceError)  # noqa: PT017 - it may also end well
        else:
            assert_open(device, mod)
        assert host.now < 5
        device.drop_answers = 0
        host.before_each = lambda _number: None
        host.close()
        assert_closed(device)
        host.start()
        assert_open(device, mod)
        assert device.violations == []


def test_a_lost_answer_to_normal_mode_is_asked_for_again(device: Device) -> None:
    host = Host(device, adapter_for())

    def lose(_number: int) -> None:
        if settings(device)[-1:] == ["COMMAND 3"] and device.record[-1] == "COMMAND 128":
            device.drop_answers = 1

    host.before_each = lose
    host.start()
    assert device.counters.answers_dropped == 1
    assert settings(device) == MANUAL_START
    assert_open(device)


def test_stopped_at_any_step_it_is_closed() -> None:
    number_of_steps = started(Device()).asked
    for words in MODES.values():
        for steps in range(number_of_steps + 1):
            device = Device()
            ask(device, words)
            host = Host(device, adapter_for())
            host.start(steps)
            host.close()
            assert settings(device)[-2:] == MANUAL_END
            assert_closed(device)
            assert device.violations == []


def test_a_device_that_was_reset_is_closed_without_a_wrong_word(device: Device) -> None:
    host = started(device)
    device.power_cycle(host.now)
    host.close()
    assert_closed(device)
    host.start()
    assert_open(device)


# --- the frames that it has taken -------------------------------------------------------------


def test_frames_in_its_buffer_are_on_the_bus_before_it_is_closed() -> None:
    device = Device(version="HW0003FW3016")
    host = started(device, adapter_for(channel(BitTiming(10_000))))
    for _ in range(40):
        device.host_writes(host.now, WRITTEN)
        device._forget_stop()  # its host is of the worst kind
    begin = host.now
    host.close()
    assert (device.counters.frames_sent, device.counters.frames_discarded) == (40, 0)
    assert 0.2 < host.now - begin < 1.0
    assert_closed(device)
    assert device.violations == []


def test_frames_that_cannot_leave_do_not_keep_it_open() -> None:
    device = Device()
    host = started(device)
    device.set_bus_off(host.now, True)
    device.host_writes(host.now, WRITTEN * 5)
    begin = host.now
    host.close()
    assert device.counters.frames_discarded == 5
    assert host.now - begin < 0.3
    assert_closed(device)
    assert device.violations == []


def test_a_silent_device_is_not_waited_for() -> None:
    host = started(device := opened())
    device.silent = True
    begin = host.now
    host.close()
    assert host.now - begin < 1.5
    assert_closed(device)
    assert device.violations == []


# --- words ------------------------------------------------------------------------------------


def looked(host: Host) -> Observation:
    """What the answers to the health questions say."""
    questions = host.adapter.health_questions()
    answers: list[Answer | None] = [None] * len(questions)
    for number, question in enumerate(questions):
        assert host.adapter.read_health(answers) is None
        answers[number] = host.ask(question.request, question.prefix, question.timeout_s)
    seen = host.adapter.read_health(answers)
    assert seen
    return seen


def test_health(device: Device) -> None:
    host = started(device)
    assert looked(host) == Observation("bus good (TEC=0 REC=0)", BusState.ERROR_ACTIVE, tec=0, rec=0)
    device.set_error_counters(host.now, 130, 4)
    assert looked(host) == Observation("bus good (TEC=130 REC=4)", BusState.ERROR_PASSIVE, tec=130, rec=4)
    device.set_error_counters(host.now, 0, 0)
    device.set_bus_off(host.now, True)
    seen = looked(host)
    assert (seen.state, seen.happened) == (BusState.BUS_OFF, Happened.RESTARTED)
    device.set_bus_off(host.now, False)
    seen = looked(host)
    assert (seen.state, seen.happened) == (BusState.ERROR_ACTIVE, Happened.NOTHING)


def test_health_of_a_device_in_another_mode(device: Device) -> None:
    """It would answer the questions about its buffer, and take no frame."""
    host = started(device)
    ask(device, MODES["config"])
    with pytest.raises(AdapterError, match="is in mode CONFIG"):
        looked(host)


def test_health_of_a_device_that_is_silent() -> None:
    device = Device()
    host = started(device)
    device.silent = True
    assert looked(host) == Observation("unknown")


def test_reports() -> None:
    device = Device()
    adapter = started(device).adapter

    def describe(text: bytes) -> str | None:
        seen = adapter.read_report(text)
        return seen and seen.description

    registers = bytes((0xC0, 1, 2, 0, 127))
    texts = [bytes((BUS_OFF, 5)) + registers, bytes((BUS_OFF, 6)) + registers + b"\xc0"]
    for text in texts:
        assert describe(text) == "bus-off, it restarts by itself (TEC=127 REC=0)"
    crossed = "error counters crossed the warning limit (TEC=96 REC=3)"
    assert describe(bytes((ERROR, 6, 1, 0, 0x19, 3, 96, 0x40))) == crossed
    assert describe(bytes((ERROR, 7, 1, 0x40, 0, 0x19, 3, 96, 0x40))) == crossed
    assert describe(bytes((GET_MODE, 1, 2))) is None
    for mode, name in {0: "BOOT", 1: "CONFIG", 3: "LOOPBACK"}.items():
        with pytest.raises(
            AdapterError, match=f"is in mode {name}: it was reset, or another program uses it"
        ):
            describe(bytes((GET_MODE, 1, mode)))
    assert describe(bytes((0x12, 1, 0))) is None
    assert adapter_for().read_report(bytes((GET_MODE, 1, 0))) is None  # not running: nothing to it
    assert device.violations == []


def test_what_the_device_reports_can_be_described() -> None:
    device = Device()
    adapter = started(device).adapter
    device.chip.latch_error(0x1F, 0x19)
    device.set_error_counters(1.0, 96, 3)
    device.set_bus_off(1.0, True)
    texts = [text for _, text, _ in _relay.decode("usb2can", [device.take_output(1.0)])]
    assert [adapter.read_report(text) for text in texts] == [
        Observation(
            "error counters crossed the warning limit (TEC=96 REC=3)", BusState.ERROR_WARNING, tec=96, rec=3
        ),
        Observation("bus-off, it restarts by itself (TEC=127 REC=0)", BusState.BUS_OFF, tec=127, rec=0),
    ]
    assert device.violations == []


def test_only_mode_normal_answers_the_sync(device: Device) -> None:
    host = started(device)
    sync = host.adapter.sync
    assert host.ask(sync.request, sync.prefix, sync.timeout_s).reply is Reply.TEXT
    device.power_cycle(host.now)
    assert host.ask(sync.request, sync.prefix, sync.timeout_s).reply is Reply.NONE
