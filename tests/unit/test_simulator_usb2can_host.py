"""What the simulated USB2CAN makes of any bytes, and what it holds against its host."""

import json

import pytest
from benches.usb2can_words import (
    BOOT,
    CONFIG,
    FRAME,
    FRAME_S,
    FW_VERSION,
    GET,
    GET_MODE,
    GO,
    LIMITS,
    LOOPBACK,
    NORMAL,
    OPEN,
    SETUP,
    STEPS,
    STEPS_2_TO_8,
    STOP,
    WRITTEN,
    ask,
    check_balance,
    hexed,
    opened,
    reg,
)
from hypothesis import given
from hypothesis import strategies as st

from bridged.simulators.sja1000 import Frame, bitrate
from bridged.simulators.usb2can import Usb2can

# Bytes from the host


def test_half_a_message_waits_for_ever():
    device = opened()
    assert ask(device, "0F 06") == b""
    assert hexed(device, "00", 3600) == "0F060102"
    assert ask(device, "0F 21 00 0F", 3600)[1] == 0x21
    assert hexed(device, "06 00", 7200) == "0F060102"


def test_bytes_between_messages_are_skipped():
    device = opened()
    assert hexed(device, "00 FF 0D" + GET_MODE + "80") == "0F060102"
    assert device.counters.bytes_skipped == 4
    assert device.violations == []


@pytest.mark.parametrize("junk", ["0F", "0F0F", "0FFF", "0F05", "0F2111", "0F40FF", "0F410B"])
def test_the_search_goes_on_at_the_next_start_byte(junk: str):
    device = opened()
    assert hexed(device, junk + GET_MODE) == "0F060102"
    assert device.violations
    assert device.counters.bytes_skipped == len(junk) // 2


def test_a_start_byte_in_the_data_is_data():
    device = opened()
    assert ask(device, "0F400B080F000F06000F06000F06") == b""
    device.advance(1)
    assert device.take_bus_frames() == [Frame(0x078, False, False, 8, bytes.fromhex("0F06000F06000F06"))]


pieces = st.lists(
    st.sampled_from([CONFIG, NORMAL, LOOPBACK, GET_MODE, GET, FW_VERSION, *LIMITS, OPEN, WRITTEN.hex() * 3,
                     reg(0, 0), reg(0, 1), "0F0F", "0F", "0F21", "0F0E", "0F1211"]).map(bytes.fromhex)
    | st.binary(max_size=8),
    max_size=12,
).map(b"".join)  # fmt: skip


@given(data=pieces, cuts=st.lists(st.integers(0, 300)), processing_s=st.sampled_from([0.0, 0.0001]))
def test_the_device_does_the_same_however_the_bytes_are_cut(
    data: bytes, cuts: list[int], processing_s: float
):
    outcomes = []
    places = sorted({cut for cut in cuts if cut < len(data)})
    for ends in ([], places, range(1, len(data))):
        device = Usb2can(processing_s=processing_s)
        device.host_writes(0, bytes.fromhex(OPEN))
        device.advance(0.5)
        device.take_output(0.5)
        start = 0
        for end in [*ends, len(data)]:
            device.host_writes(0.5, data[start:end])
            start = end
        outcomes.append((device.take_output(1.0), device.take_bus_frames(), device.report()))
        check_balance(device)
    assert outcomes[0] == outcomes[1] == outcomes[2]


# What a host must not do


@pytest.mark.parametrize(
    ("preparation", "commands", "words"),
    [
        ("", "0F7F0400050000", "WRITE_INSTRUCTION 00 05 00 00: writes the firmware"),
        (OPEN, "0F7F0400050000", "WRITE_INSTRUCTION 00 05 00 00: writes the firmware"),
        (OPEN, BOOT, "BOOT_MODE: it serves to flash the firmware only"),
        (CONFIG, "0F1300", "WRITE_REG_BLOCK: this device does not have it"),
        (CONFIG, "0F1100", "READ_REG_BLOCK: this device does not have it"),
        (OPEN, "0F4A00", "SUPPORTED_SYNC_MESSAGE: this device does not have it"),
        ("", "0FEF", "unknown command 239"),
        (OPEN, "0F41030000" + "00", "unknown command 65"),
        (OPEN, "0F4011", "WRITE_MESSAGE with LENGTH 17"),
        (OPEN, "0F060100", "GET_MODE 00: 1 data bytes"),
        (OPEN, "0F120100", "WRITE_REG 0: 1 data bytes"),
        (OPEN, "0F40020000", "WRITE_MESSAGE 00 00: 2 data bytes"),
        (OPEN, "0F4003012460", "WRITE_MESSAGE 01 24 60: the length does not fit the frame information"),
        (OPEN, "0F40040024600A", "WRITE_MESSAGE 00 24 60 0A: the length does not fit the frame information"),
        (OPEN, "0F400441246000", "WRITE_MESSAGE 41 24 60 00: the length does not fit the frame information"),
        (OPEN, "0F4003802460", "WRITE_MESSAGE 80 24 60: the length does not fit the frame information"),
        (OPEN, "0F400B0F2460" + "00" * 8, "WRITE_MESSAGE 0F 24 60 00 00 00 00 00 00 00 00: the length"),
        (OPEN, "0F400C092460" + "00" * 9, "WRITE_MESSAGE 09 24 60 00 00 00 00 00 00 00 00 00: the length"),
        (CONFIG, "0F200140", "COMMAND 64: unknown"),
        (CONFIG, "0F200100", "COMMAND 0: 1 data bytes"),
        (CONFIG, "0F20020800", "COMMAND 8 0: 2 data bytes"),
        (OPEN, "0F2003084014", "COMMAND 8 64 20: in NORMAL mode"),
        (OPEN, "0F200106", "COMMAND 6: in NORMAL mode"),
        (CONFIG, "0F20020013", "limits: critical 19, ready 0"),
        (CONFIG, "0F20020112", "limits: critical 18, ready 18"),
        (CONFIG + LIMITS[0], "0F2002010F", "limits: critical 15, ready 15"),
        (OPEN, "0F20020007", "limits: critical 7, ready 7"),
        (OPEN, reg(6, 0x40), "BTR0 = 0x40: not outside of the chip's reset mode"),
        (CONFIG + reg(0, 0), reg(16, 0), "ACR0 = 0x00: not outside of the chip's reset mode"),
        (CONFIG + reg(0, 0), reg(23, 0), "AMR3 = 0x00: not outside of the chip's reset mode"),
        (CONFIG + reg(0, 0), reg(8, 0xDA), "OCR = 0xDA: not outside of the chip's reset mode"),
        (CONFIG + reg(0, 0), reg(31, 0xC0), "CDR = 0xC0: not outside of the chip's reset mode"),
        (CONFIG + reg(0, 0), "0F2003084014", "BTR0 = 0x40: not outside of the chip's reset mode"),
        (OPEN, reg(0, 0x08), "MOD = 0x08: not outside of the chip's reset mode"),
        (OPEN, "0F1503000202", "MOD = 0x02: not outside of the chip's reset mode"),
        (OPEN + reg(0, 1), reg(6, 0x40), "BTR0 = 0x40: in NORMAL mode"),
        (SETUP + LOOPBACK, reg(20, 0), "AMR0 = 0x00: in LOOPBACK mode"),
        (OPEN + reg(0, 1), reg(31, 0xC0), "CDR = 0xC0: in NORMAL mode"),
        (CONFIG, reg(2, 0), "SR = 0x00: cannot be written"),
        (CONFIG, reg(9, 0), "register 9 = 0x00: cannot be written"),
    ],
)
def test_violations(preparation: str, commands: str, words: str):
    device = Usb2can()
    ask(device, preparation)
    assert device.violations == []
    record = device.record
    answer = hexed(device, commands)
    assert device.violations[0].startswith(words)
    if "mode" not in words and "limits" not in words and "=" not in words and "BOOT" not in words:
        assert answer == ""
        assert device.record == record


@pytest.mark.parametrize(
    "commands",
    [
        OPEN + CONFIG + reg(0, 1),  # the manual's end, dual filter
        SETUP + NORMAL + reg(0, 8) + CONFIG + reg(0, 1),  # single filter: bit 3 is not meant to change yet
        SETUP + NORMAL + reg(0, 2) + CONFIG + reg(0, 1) + STEPS_2_TO_8 + NORMAL + reg(0, 0),
        OPEN + OPEN + OPEN,
        CONFIG + CONFIG + STEPS_2_TO_8 + LOOPBACK + NORMAL + LOOPBACK + NORMAL,
        CONFIG + STEPS[2][0] + STEPS[3][0] + STEPS_2_TO_8 + NORMAL,  # begun anew
        CONFIG + STEPS_2_TO_8.replace(STEPS[5][0], STEPS[5][0] * 2) + NORMAL,  # an answer was lost
        SETUP.replace("0F1202", "0F1402") + NORMAL,  # WRITE_READ_REG
        SETUP.replace(STEPS[7][0] + STEPS[7][1], "0F200308401C") + NORMAL,  # BAUD_RATE
        SETUP.replace(LIMITS[0] + LIMITS[1], LIMITS[1] + LIMITS[0]) + NORMAL,
        CONFIG + "0F20020112"[:-2] + "11" + "0F20020012" + CONFIG + STEPS_2_TO_8.replace(
            LIMITS[0] + LIMITS[1], LIMITS[1] + LIMITS[0]) + NORMAL,  # from 18, 17 down to 15, 7
        SETUP + "0F200102" + "0F200103" + NORMAL,
    ],
)  # fmt: skip
def test_what_a_host_may_do(commands: str):
    device = Usb2can()
    ask(device, commands)
    assert device.violations == []


@pytest.mark.parametrize("step", STEPS)
def test_no_step_of_the_initialisation_may_be_left_out(step: int):
    for left_out in STEPS[step]:
        device = Usb2can()
        commands = "".join(command for all_of in STEPS.values() for command in all_of if command != left_out)
        ask(device, CONFIG + commands + NORMAL)
        assert any(
            words.startswith("NORMAL_MODE: no ") and f"(step {step})" in words for words in device.violations
        )


@pytest.mark.parametrize("first", range(2, 8))
def test_the_steps_have_their_order(first: int):
    order = list(STEPS)
    order[first - 2], order[first - 1] = first + 1, first
    device = Usb2can()
    ask(device, CONFIG + "".join("".join(STEPS[step]) for step in order) + NORMAL)
    assert any(words.startswith("NORMAL_MODE: ") for words in device.violations)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (reg(31, 0x80), "CDR = 0x80, not 0xC0 (step 3)"),
        (reg(8, 0x1A), "OCR = 0x1A, not 0xDA (step 5)"),
        (reg(4, 0xFF), "IER = 0xFF, not 0x03 (step 6)"),
        (reg(0, 0x05), "MOD = 0x05, not 0x01 (step 2)"),
    ],
)
def test_the_values_that_the_manual_gives_are_not_to_be_changed(wrong: str, words: str):
    device = Usb2can()
    ask(device, CONFIG + "".join(
        wrong if command[:8] == wrong[:8] else command for step in STEPS.values() for command in step
    ) + NORMAL)  # fmt: skip
    assert device.violations == [f"NORMAL_MODE: {words}"]


def test_a_stop_is_to_be_obeyed_within_the_grace():
    device = Usb2can(stop_grace_s=0.002)
    slow = Usb2can()
    for either in (device, slow):
        ask(either, OPEN.replace(reg(6, 0x40), reg(6, 0x03)))  # 125 kbit/s
    for now, count in ((0.0, 10), (0.001, 10)):
        device.host_writes(now, WRITTEN * count)
        slow.host_writes(now, WRITTEN * count)
    assert STOP in device.take_output(0.001)  # it is only now that the host can know
    device.host_writes(0.003, WRITTEN)
    assert device.violations == []
    device.host_writes(0.0035, WRITTEN)
    assert device.violations == ["WRITE_MESSAGE 0.002500 s after a STOP"]
    device.advance(1)  # GO was said, but the host has not read it
    device.host_writes(1, WRITTEN)
    assert len(device.violations) == 1
    slow.advance(1)  # a host that reads neither STOP nor GO
    slow.host_writes(1, WRITTEN)
    assert slow.take_output(1) == STOP + GO
    slow.host_writes(2, WRITTEN * 16)
    assert slow.violations == []


def test_violations_and_record_do_not_grow_for_ever():
    device = Usb2can()
    ask(device, CONFIG + WRITTEN.hex() * 3000 + GET_MODE * 3000)
    assert (len(device.violations), device.counters.violations) == (1000, 3000)
    assert device.record == ["GET_MODE"] * 200


@pytest.mark.parametrize("version", ["", "V1324", "HW0003FW001", "HW0003FW0016\n", "hw0003fw0016"])
def test_a_version_has_its_form(version: str):
    with pytest.raises(ValueError, match="not of the form"):
        Usb2can(version=version)


def test_the_report_is_fit_for_json():
    device = opened()
    ask(device, WRITTEN.hex() + BOOT)
    report = json.loads(json.dumps(device.report()))
    assert (report["state"], report["bitrate"], report["powered"]) == ("boot", bitrate(0, 0), True)
    assert report["counters"]["commands"]["WRITE_MESSAGE"] == 1
    assert report["record"][-1] == "BOOT_MODE"
    assert len(report["violations"]) == report["counters"]["violations"] == 1


def test_a_new_beginning_and_a_frame_in_one_write_after_a_stop():
    device = opened()
    assert ask(device, WRITTEN.hex() * 16) == STOP
    ask(device, CONFIG + STEPS_2_TO_8 + NORMAL + reg(0, 0) + WRITTEN.hex(), FRAME_S)
    assert device.violations == []
    assert (device.waiting, device.counters.frames_discarded) == (1, 15)


# Anything at all

actions = st.lists(
    st.one_of(
        st.tuples(st.just("host"), pieces),
        st.tuples(st.just("frames"), st.integers(1, 30)),
        st.tuples(st.just("received"), st.integers(1, 80)),
        st.tuples(st.just("wait"), st.floats(0, 0.01)),
        st.tuples(st.just("take"), st.none()),
        st.tuples(st.just("bus off"), st.booleans()),
        st.tuples(st.just("power"), st.none()),
        st.tuples(st.just("errors"), st.integers(0, 255)),
        st.tuples(st.just("silent"), st.booleans()),
        st.tuples(st.just("refuse"), st.integers(0, 3)),
        st.tuples(st.just("lose go"), st.integers(0, 3)),
    ),
    max_size=25,
)


@given(actions=actions, version=st.sampled_from(["HW0003FW0016", "HW0003FW3001", "HW0003FW5001"]))
def test_whatever_happens_no_frame_is_unaccounted_for(actions: list[tuple[str, object]], version: str):
    device = Usb2can(version=version)
    device.host_writes(0, bytes.fromhex(OPEN))
    now, on_bus, seen = 0.0, 0, 0
    for action, value in actions:
        match action, value:
            case "host", bytes(data):
                device.host_writes(now, data)
            case "frames", int(count):
                device.host_writes(now, WRITTEN * count)
            case "received", int(count):
                for _ in range(count):
                    device.bus_frame(now, FRAME)
                seen += count
            case "wait", float(seconds):
                now += seconds
                device.advance(now)
            case "take", None:
                device.take_output(now)
            case "bus off", bool(on):
                device.set_bus_off(now, on)
            case "power", None:
                device.power_cycle(now)
            case "errors", int(count):
                device.set_error_counters(now, count, 0)
            case "silent", bool(on):
                device.silent = on
            case "refuse", int(count):
                device.refusals = count
            case _, int(count):
                device.lose_go = count
        on_bus += len(device.take_bus_frames())
        check_balance(device)
        counters = device.counters
        assert counters.frames_sent == on_bus
        assert device.waiting <= device.variant.capacity
        assert seen == (
            counters.frames_received
            + counters.frames_lost
            + counters.frames_filtered
            + counters.frames_unseen
        )
        assert counters.stops >= counters.gos or device.violations
        assert device.next_deadline() >= now
        json.dumps(device.report())


def test_a_message_has_16_data_bytes_at_most():
    device = Usb2can()
    ask(device, CONFIG)
    assert hexed(device, "0F1310" + "0F" * 16 + GET_MODE) == "0F060101"
    assert device.counters.bytes_skipped == 0


def test_reading_again_does_not_put_a_stop_off():
    device = Usb2can(stop_grace_s=0.001)
    ask(device, OPEN.replace(reg(6, 0x40), reg(6, 0x03)))  # 125 kbit/s
    assert ask(device, WRITTEN.hex() * 16) == STOP
    assert hexed(device, GET_MODE, 0.0009) == "0F060102"
    device.host_writes(0.0011, WRITTEN)
    assert len(device.violations) == 1
