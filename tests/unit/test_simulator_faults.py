"""What befalls simulated adapters: listen-only that nobody asked for, refusals; faults on request."""

import os

from benches.can232_words import FRAME, opened
from benches.can232_words import ask as ask_can232
from benches.simulating import ask as ask_terminal
from benches.simulating import by_hand, host, running, until
from benches.usb2can_words import GET_MODE, OPEN, check_balance
from benches.usb2can_words import ask as ask_usb2can
from benches.usb2can_words import opened as opened_usb2can

from bridged.simulators.can232 import Can232, State
from bridged.simulators.faults import Fault, begin, end
from bridged.simulators.sja1000 import MOD, Sja1000

WRITE_FRAME = bytes.fromhex("0F4005022000" + "1133")
IN_NORMAL = bytes.fromhex("0F060102")


def test_a_can232_in_listen_only_refuses_frames_and_says_nothing_else():
    device = opened()
    begin(device, Fault("listenonly", 0), 1.0)
    assert device.state is State.LISTEN_ONLY
    assert ask_can232(device, "t1000\rF\r", 1.0) == "\aF00\r"
    device.bus_frame(1.0, FRAME)
    assert ask_can232(device, "P\r", 1.0) == "t10021133\r"
    assert ask_can232(device, "C\rO\rt1000\r", 2.0) == "\r\r\r"


def test_a_can232_returns_from_listen_only_by_itself():
    device = opened()
    fault = Fault("listenonly", 0, 1)
    begin(device, fault, 1.0)
    end(device, fault, 2.0)
    assert ask_can232(device, "t1000\r", 2.0) == "\r"
    closed = Can232()
    begin(closed, fault, 1.0)
    assert closed.state is State.UNINITIATED


def test_a_can232_refuses_every_command():
    device = opened()
    fault = Fault("refuseall", 0, 1)
    begin(device, fault, 1.0)
    assert ask_can232(device, "V\rF\rt1000\rC\r", 1.0) == "\a" * 4
    end(device, fault, 2.0)
    assert ask_can232(device, "V\rF\rt1000\r", 2.0) == "V1324\rF00\r\r"


def test_a_usb2can_in_listen_only_keeps_its_frames_until_it_is_set_up_again():
    device = opened_usb2can()
    begin(device, Fault("listenonly", 0), 1.0)
    assert device.chip.read(MOD) == 0x02
    device.host_writes(1.0, WRITE_FRAME)
    assert ask_usb2can(device, GET_MODE, 5.0) == IN_NORMAL
    assert device.take_bus_frames() == []
    assert device.waiting == 1
    assert device.violations == []  # the host cannot know
    ask_usb2can(device, OPEN, 6.0)
    device.host_writes(6.0, WRITE_FRAME)
    device.advance(7.0)
    assert len(device.take_bus_frames()) == 1
    check_balance(device)


def test_a_usb2can_returns_from_listen_only_by_itself():
    device = opened_usb2can()
    fault = Fault("listenonly", 0, 1)
    begin(device, fault, 1.0)
    device.host_writes(1.0, WRITE_FRAME)
    end(device, fault, 2.0)
    device.advance(3.0)
    assert len(device.take_bus_frames()) == 1
    assert device.chip.read(MOD) == 0


def test_listen_only_is_forced_on_a_chip_that_runs():
    chip = Sja1000()
    chip.write(MOD, 0)
    assert not chip.write(MOD, 0x02)  # the proper way is closed
    chip.force_listen_only(True)
    assert (chip.listen_only, chip.in_reset) == (True, False)
    chip.force_listen_only(False)
    assert (chip.listen_only, chip.read(MOD)) == (False, 0)


def test_faults_are_had_on_request():
    simulator, clock = by_hand()
    device = simulator.device
    with running(simulator), host(simulator.port) as fd:
        ask_terminal(fd, b"S8\rO\r", b"\r\r")
        clock.now = 5.0
        simulator.begin(Fault("listenonly", 1, 2))
        simulator.begin(Fault("refuse", 0))
        until(lambda: device.refusals)
        ask_terminal(fd, b"t1000\rt1000\r", b"\a\r")
        clock.set(6.0)
        until(lambda: device.state is State.LISTEN_ONLY)
        ask_terminal(fd, b"t1000\r", b"\a")
        clock.set(8.0)
        until(lambda: device.state is State.OPEN)
        simulator.begin(Fault("refuseall", 0, 1))
        until(lambda: isinstance(device, Can232) and device.refuses_all)
        ask_terminal(fd, b"V\r", b"\a")
        clock.set(9.0)
        until(lambda: isinstance(device, Can232) and not device.refuses_all)
        os.write(fd, b"C\r")
        until(lambda: device.state is State.CLOSED)
