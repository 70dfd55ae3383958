"""The simulated USB2CAN against its manual: messages, modes, registers, filter, transmit buffer."""

import math

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
    READ_REC,
    READ_RST,
    READ_TEC,
    RECEIVED,
    SETUP,
    STEPS,
    STEPS_2_TO_8,
    STOP,
    VALUE_2,
    WRITTEN,
    ask,
    check_balance,
    hexed,
    messages,
    opened,
    reg,
)

from bridged.simulators.sja1000 import Frame, bitrate, frame_bits
from bridged.simulators.usb2can import State, Usb2can

# Golden bytes


def test_the_public_log_of_a_real_device():
    device = Usb2can()
    assert hexed(device, CONFIG) == "FFFF"
    assert hexed(device, CONFIG) == "FFFF"  # the known client says it twice
    assert hexed(device, reg(0, 1)) == "0F120100"
    assert hexed(device, reg(31, 0xC0)) == "0F12011F"
    assert ask(device, FW_VERSION) == b"\x0f\x21\x0cHW0003FW0016"
    assert hexed(device, "0F130B10" + "00" * 10) == ""  # WRITE_REG_BLOCK
    assert hexed(device, NORMAL) == "0F09020202"  # no limits have been set
    device.advance(0.35)
    assert device.take_output(0.35) == VALUE_2 * 3
    assert hexed(device, LIMITS[0] + LIMITS[1], 0.35) == ""
    assert device.take_output(10) == b""


def test_the_manuals_initialisation_and_its_end():
    device = Usb2can()
    answers = ask(device, OPEN)
    assert answers[:2] == b"\xff\xff"
    registers = [0, 31, *range(16, 24), 8, 4, 6, 7, 0]
    assert messages(answers[2:]) == [(18, bytes((register,))) for register in registers]
    assert device.record == [
        "CONFIG_MODE", "WRITE_REG 0 0x01", "WRITE_REG 31 0xC0",
        "WRITE_REG 16 0x00", "WRITE_REG 17 0x00", "WRITE_REG 18 0x00", "WRITE_REG 19 0x00",
        "WRITE_REG 20 0xFF", "WRITE_REG 21 0xFF", "WRITE_REG 22 0xFF", "WRITE_REG 23 0xFF",
        "WRITE_REG 8 0xDA", "WRITE_REG 4 0x03", "WRITE_REG 6 0x40", "WRITE_REG 7 0x1C",
        "COMMAND 0 15", "COMMAND 1 7", "NORMAL_MODE", "WRITE_REG 0 0x00",
    ]  # fmt: skip
    assert device.chip.bitrate == bitrate(0x40, 0x1C) == 500_000
    assert hexed(device, WRITTEN.hex(), 1) == ""
    device.bus_frame(1, FRAME)
    assert device.take_output(1) == RECEIVED
    device.advance(2)
    assert device.take_bus_frames() == [FRAME]
    assert hexed(device, CONFIG + reg(0, 1) + GET_MODE, 2) == "FFFF" + "0F120100" + "0F060101"
    assert device.record[-3:] == ["CONFIG_MODE", "WRITE_REG 0 0x01", "GET_MODE"]
    assert device.violations == []


FRAMES = [  # as in the buffers of the chip
    ("00 FF E0", Frame(0x7FF, False, False, 0, b"")),
    ("08 24 60 00 01 02 03 04 05 06 07", Frame(0x123, False, False, 8, bytes(range(8)))),
    ("80 FF FF FF F8", Frame(0x1FFFFFFF, True, False, 0, b"")),
    ("88 91 A2 B3 C0 00 01 02 03 04 05 06 07", Frame(0x12345678, True, False, 8, bytes(range(8)))),
    ("83 00 00 00 08 0F 0F 0F", Frame(1, True, False, 3, b"\x0f\x0f\x0f")),
]


@pytest.mark.parametrize(("data", "frame"), FRAMES)
def test_frames_both_ways(data: str, frame: Frame):
    device = opened()
    raw = bytes.fromhex(data)
    device.host_writes(0, bytes((0x0F, 64, len(raw))) + raw)
    device.advance(1)
    assert device.take_bus_frames() == [frame]
    device.bus_frame(1, frame)
    assert device.take_output(1) == bytes((0x0F, 65, len(raw))) + raw


@pytest.mark.parametrize(
    ("written", "frame", "received"),
    [
        ("44 24 60", Frame(0x123, False, True, 4, b""), "44 24 70"),
        ("C8 91 A2 B3 C0", Frame(0x12345678, True, True, 8, b""), "C8 91 A2 B3 C4"),
    ],
)
def test_a_remote_frame_has_a_length_no_data_and_its_rtr_bit_twice_when_received(
    written: str, frame: Frame, received: str
):
    device = opened()
    raw = bytes.fromhex(written)
    device.host_writes(0, bytes((0x0F, 64, len(raw))) + raw)
    device.advance(1)
    assert device.take_bus_frames() == [frame]
    device.bus_frame(1, frame)
    assert messages(device.take_output(1)) == [(65, bytes.fromhex(received))]


def test_what_the_chip_does_not_look_at_in_a_written_frame():
    device = opened()
    ask(device, "0F4003307FFF" + "0F4005B0FFFFFFFF")
    device.advance(1)
    assert device.take_bus_frames() == [
        Frame(0x3FF, False, False, 0, b""),
        Frame(0x1FFFFFFF, True, False, 0, b""),
    ]


# Modes

PREPARE = {
    State.BOOT: "",
    State.CONFIG: SETUP,
    State.NORMAL: OPEN,
    State.LOOPBACK: SETUP + LOOPBACK,
}


@pytest.mark.parametrize(
    ("command", "modes", "answer"),
    [
        ("0F0000", "BCNL", "0F0000"),
        (CONFIG, "BCNL", "FFFF"),
        (NORMAL, "CL", ""),
        (LOOPBACK, "CN", ""),
        (GET_MODE, "BCNL", None),
        ("0F100104", "CNL", "0F10020403"),
        (reg(4, 7), "CNL", "0F120104"),
        ("0F14020407", "CNL", "0F14020407"),
        ("0F1503040404", "CNL", "0F1503040404"),
        ("0F1603040404", "CNL", "0F160404040407"),
        (LIMITS[0], "CNL", ""),
        (LIMITS[1], "CNL", ""),
        ("0F200102", "CNL", ""),
        ("0F200103", "CNL", ""),
        ("0F200104", "C", ""),
        ("0F200105", "C", ""),
        ("0F200106", "C", ""),
        ("0F200107", "C", ""),
        ("0F2003084014", "C", ""),
        (GET, "CNL", "0F2005800F070000"),
        (FW_VERSION, "CNL", "0F210C" + b"HW0003FW0016".hex().upper()),
        (READ_RST, "N", "0F62020000"),
    ],
)
def test_each_command_works_in_its_modes_only(command: str, modes: str, answer: str | None):
    for state, preparation in PREPARE.items():
        device = Usb2can()
        ask(device, preparation)
        assert (device.state, device.violations) == (state, [])
        works = state.name[0] in modes
        expected = answer if works else ""
        if answer is None:
            expected = f"0F0601{list(State).index(state):02X}"
        carried_out = len(device.record)
        assert hexed(device, command) == expected, state
        assert len(device.violations) == (not works), device.violations
        assert len(device.record) == carried_out + works
        if not works:
            assert device.state is state
            assert f"in {state.name} mode" in device.violations[0]


def test_write_messages_mode():
    for state, preparation in PREPARE.items():
        device = Usb2can()
        ask(device, preparation)
        answer = ask(device, WRITTEN.hex())
        device.advance(1)
        assert answer == (RECEIVED if state is State.LOOPBACK else b"")
        assert device.take_bus_frames() == ([FRAME] if state is State.NORMAL else [])
        assert len(device.violations) == (state in {State.BOOT, State.CONFIG})
        check_balance(device)


def test_the_way_through_the_modes():
    device = Usb2can()
    for command, number in ((CONFIG, 1), (LOOPBACK, 3), (CONFIG, 1), (NORMAL, 2), (LOOPBACK, 3), (NORMAL, 2)):
        assert hexed(device, command + GET_MODE).endswith(f"0F0601{number:02X}")


def test_normal_mode_leaves_the_chip_in_reset_until_step_10():
    device = Usb2can()
    ask(device, SETUP + NORMAL)
    assert hexed(device, "0F100100") == "0F10020001"
    device.bus_frame(0, FRAME)
    assert device.take_output(0) == b""
    assert device.counters.frames_unseen == 1
    ask(device, reg(0, 0x08))
    device.bus_frame(0, FRAME)
    assert device.take_output(0) == RECEIVED


def test_frames_wait_while_the_chip_is_in_reset():
    device = Usb2can()
    ask(device, SETUP + NORMAL + WRITTEN.hex())
    assert device.violations == ["WRITE_MESSAGE: the chip is in reset mode (III.10)"]
    device.advance(1)
    assert (device.take_bus_frames(), device.waiting) == ([], 1)
    ask(device, reg(0, 0x00), 1)
    device.advance(2)
    assert device.take_bus_frames() == [FRAME]


def test_config_mode_drops_what_waits_and_says_no_go():
    device = opened()
    assert ask(device, WRITTEN.hex() * 18) == STOP
    device.advance(1.5 * FRAME_S)
    assert len(device.take_bus_frames()) == 1
    assert hexed(device, CONFIG, 1.5 * FRAME_S) == "FFFF"
    counters = device.counters
    assert (counters.frames_taken, counters.frames_sent, counters.frames_discarded) == (18, 1, 17)
    ask(device, STEPS_2_TO_8 + NORMAL + reg(0, 0), 1)
    assert ask(device, WRITTEN.hex(), 1) == b""  # no STOP is left over
    assert device.take_output(2) == b""
    assert len(device.take_bus_frames()) == 1
    assert device.violations == []
    check_balance(device)


def test_loopback_mode_has_no_bus():
    device = Usb2can()
    ask(device, SETUP + LOOPBACK + reg(0, 0))
    assert ask(device, WRITTEN.hex() * 100) == RECEIVED * 100
    device.bus_frame(0, FRAME)
    assert device.take_output(1) == b""
    assert (device.counters.frames_echoed, device.counters.frames_unseen) == (100, 1)
    assert device.take_bus_frames() == []


def test_boot_mode_is_like_power_on():
    device = opened()
    ask(device, WRITTEN.hex() + BOOT)
    assert device.state is State.BOOT
    assert hexed(device, CONFIG + "0F100106" + GET) == "FFFF" + "0F10020600" + "0F20058000000000"
    assert device.violations == ["BOOT_MODE: it serves to flash the firmware only"]
    check_balance(device)


# Registers and settings


def test_registers_after_power_on_and_written():
    device = Usb2can()
    ask(device, CONFIG)
    assert hexed(device, "0F100100") == "0F10020001"
    assert hexed(device, "0F100102") == "0F1002023C"
    assert hexed(device, "0F14020840") == "0F14020840"  # WRITE_READ_REG
    assert hexed(device, "0F16030801FF") == "0F16040801FF41"  # BITMOD_READ_REG
    assert hexed(device, "0F1503084000") == "0F1503084000"  # BITMOD_REG
    assert hexed(device, "0F100108") == "0F10020801"
    assert device.violations == []


def test_the_record_says_what_was_carried_out():
    device = Usb2can()
    ask(device, CONFIG + "0F100108" + "0F14020840" + "0F1503084000" + "0F16030801FF" + "0F2003084014" + GET)
    assert device.record[1:] == [
        "READ_REG 8", "WRITE_READ_REG 8 0x40", "BITMOD_REG 8 0x40 0x00", "BITMOD_READ_REG 8 0x01 0xFF",
        "COMMAND 8 64 20", "COMMAND 128",
    ]  # fmt: skip


def test_a_register_that_does_not_take_the_value_answers_all_the_same():
    device = opened()
    assert hexed(device, reg(6, 0x00)) == "0F120106"
    assert hexed(device, "0F14020700") == "0F1402071C"
    assert hexed(device, "0F160306FF00") == "0F160406FF0040"
    assert len(device.violations) == 3
    assert device.chip.bitrate == 500_000


def test_settings_by_command():
    device = Usb2can()
    ask(device, CONFIG + "0F2003080014")
    assert device.chip.bitrate == 1_000_000
    ask(device, "0F200107")  # OPERATING_MODE
    assert hexed(device, "0F100100") == "0F10020000"
    ask(device, "0F200106")  # RESET_MODE
    assert hexed(device, "0F100100") == "0F10020001"
    ask(device, "0F200104")
    assert hexed(device, "0F10011F") == "0F10021F00"
    ask(device, "0F200105")
    assert hexed(device, "0F10011F") == "0F10021F80"
    assert device.violations == []


def test_basic_can_carries_no_frames():
    device = opened()
    ask(device, CONFIG + reg(0, 1) + "0F200104" + NORMAL + reg(0, 0))
    device.bus_frame(0, FRAME)
    assert device.counters.frames_unseen == 1


def test_get_tells_limits_and_what_waits():
    device = opened()
    ask(device, WRITTEN.hex() * 5)
    assert hexed(device, GET) == "0F2005800F070500"
    doubled = opened(version="HW0003FW3001")
    ask(doubled, WRITTEN.hex() * 23)
    assert hexed(doubled, GET) == "0F2005800F071403"
    assert hexed(opened(get_length_4=True), GET) == "0F20040F070000"
    silent = opened(answers_get=False)
    assert hexed(silent, GET) == ""
    assert silent.violations == []


def test_error_counters_are_read_once_it_was_allowed():
    device = opened()
    device.set_error_counters(0, 5, 9)
    assert hexed(device, READ_TEC + READ_REC) == ""
    assert device.violations == ["READ_TEC: not enabled", "READ_REC: not enabled"]
    ask(device, "0F200102")
    assert hexed(device, READ_TEC + READ_REC) == "0F600105"
    ask(device, "0F200103")
    assert hexed(device, READ_REC) == "0F610109"
    assert len(device.violations) == 3


# Acceptance filter


@pytest.mark.parametrize(("mode", "seen"), [(0x00, [0x123, 0x456]), (0x08, [0x123])])
def test_the_filter_is_dual_or_single(mode: int, seen: list[int]):
    """ACR 0x123 x 0x456 x; the single filter takes the second half for data."""
    device = Usb2can()
    filters = [0x24, 0x60, 0x8A, 0xC0, 0x00, 0x1F, 0x00, 0x1F]
    commands = "".join(reg(16 + n, value) for n, value in enumerate(filters))
    ask(device, SETUP.replace("".join(STEPS[4]), commands) + NORMAL + reg(0, mode))
    frames = [Frame(can_id, False, False, 0, b"") for can_id in (0x123, 0x124, 0x456, 0x457, 0x7FF)]
    for frame in frames:
        device.bus_frame(0, frame)
    received = messages(device.take_output(0))
    assert [data[1] << 3 | data[2] >> 5 for _, data in received] == seen
    assert device.counters.frames_filtered == 5 - len(seen)
    assert device.violations == []


# Towards the bus


def test_frames_leave_one_after_the_other_at_the_bit_rate():
    device = opened()
    long = Frame(0x1FFFFFFF, True, False, 8, bytes(8))
    device.host_writes(0, WRITTEN + bytes.fromhex("0F400D88FFFFFFF8" + "00" * 8))
    long_s = frame_bits(long) / 500_000
    assert device.next_deadline() == pytest.approx(FRAME_S)
    for now, frames in (
        (0.99 * FRAME_S, []),
        (1.01 * FRAME_S, [FRAME]),
        (FRAME_S + 0.99 * long_s, []),
        (FRAME_S + 1.01 * long_s, [long]),
    ):
        device.advance(now)
        assert device.take_bus_frames() == frames
    assert device.next_deadline() == math.inf


def test_stop_when_more_than_critical_wait_and_go_when_fewer_than_ready_do():
    device = opened()
    assert ask(device, WRITTEN.hex() * 15) == b""
    assert ask(device, WRITTEN.hex()) == STOP
    assert ask(device, WRITTEN.hex() * 4) == b""  # once only, even if more come
    assert device.take_output(13.5 * FRAME_S) == b""
    assert device.waiting == 7
    assert device.take_output(14.5 * FRAME_S) == GO
    assert device.take_output(1) == b""
    assert (device.counters.stops, device.counters.gos) == (1, 1)
    assert ask(device, WRITTEN.hex() * 16, 1) == STOP
    assert device.violations == []
    check_balance(device)


def test_a_full_buffer_hands_frames_back():
    device = opened()
    assert messages(ask(device, WRITTEN.hex() * 20)) == messages(STOP)
    other = "0F400D88FFFFFFF80102030405060708"
    assert messages(ask(device, WRITTEN.hex() + other)) == [
        (9, b"\0" + WRITTEN[3:]),
        (9, b"\0" + bytes.fromhex(other)[3:]),
    ]
    assert (device.counters.frames_bounced, device.counters.frames_taken) == (2, 20)
    assert device.violations == []


def test_a_padded_bounce_is_always_13_bytes_of_frame():
    device = opened(padded=True)
    device.refusals = 1
    assert messages(ask(device, WRITTEN.hex())) == [(9, b"\0" + WRITTEN[3:] + bytes(8))]


@pytest.mark.parametrize(
    ("version", "room"),
    [("HW0002FW0004", 20), ("HW0003FW3000", 40), ("HW0003FW4000", 20), ("HW0003FW5001", 40)],
)
def test_series_3_and_5_have_two_buffers(version: str, room: int):
    device = opened(version=version)
    ask(device, WRITTEN.hex() * 50)
    assert (device.waiting, device.counters.frames_bounced) == (room, 50 - room)
    assert opened(tx_buffer=30).variant.capacity == 30


def test_a_ready_limit_of_0_means_no_go():
    device = opened()
    ask(device, "0F20020100" + WRITTEN.hex() * 16)
    assert device.take_output(1) == b""
    assert device.violations == []


def test_a_higher_ready_limit_says_go_at_once():
    device = opened()
    assert ask(device, "0F2002000A" + "0F20020101" + WRITTEN.hex() * 11) == STOP
    device.advance(8.5 * FRAME_S)
    assert ask(device, "0F20020104", 8.5 * FRAME_S) == GO


def test_nothing_is_sent_in_listen_only_mode():
    device = opened(mode=0x0A)
    ask(device, WRITTEN.hex())
    device.bus_frame(0, FRAME)
    assert device.take_output(1) == RECEIVED
    assert (device.take_bus_frames(), device.waiting) == ([], 1)
    assert device.violations == ["WRITE_MESSAGE: the chip is in listen-only mode"]
