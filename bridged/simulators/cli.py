"""`can-bridge simulate`: the options of each adapter, and its simulator until a signal ends it."""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import math
import random
import re
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

from bridged.errors import BridgeError, PortError
from bridged.simulators.can232 import Can232
from bridged.simulators.can232_memory import Eeprom
from bridged.simulators.ends import open_can
from bridged.simulators.faults import CAN232_FAULTS, MEANINGS, USB2CAN_FAULTS, parse_fault
from bridged.simulators.serve import Simulator, cyclic_frames
from bridged.simulators.uart import Uart

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from bridged.simulators.usb2can import Usb2can

ADAPTERS = {"can232": "LAWICEL CAN232", "usb2can": "CANLAB USB2CAN"}
STOP_GRACE_S = 5.0  # what a USB2CAN has told to stop may be on its way for so long


def load_eeprom(path: Path | None) -> Eeprom:
    """What a Simulator kept in a file, a new EEPROM if there is none; PortError if it is something else."""
    if path is None or not path.exists():
        return Eeprom()
    try:
        return Eeprom(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise PortError(f"{path}: not an EEPROM file of this simulator: {error}") from error


def positive(text: str) -> float:
    """A finite number above 0, for argparse."""
    with contextlib.suppress(ValueError):
        value = float(text)
        if 0 < value < math.inf:
            return value
    raise argparse.ArgumentTypeError(f"expected a number above 0, got {text!r}")


def _whole(text: str) -> int:
    with contextlib.suppress(ValueError):
        if (value := int(text)) > 0:
            return value
    raise argparse.ArgumentTypeError(f"expected a whole number above 0, got {text!r}")


def _matching(pattern: str, meaning: str) -> Callable[[str], str]:
    def check(text: str) -> str:
        if not re.fullmatch(pattern, text):
            raise argparse.ArgumentTypeError(f"{text!r} is not {meaning}")
        return text

    return check


def add_arguments(parser: argparse.ArgumentParser, adapter: str) -> None:
    """The options of `can-bridge simulate ADAPTER`, one of ADAPTERS."""
    parser.set_defaults(adapter=adapter)
    if adapter == "can232":
        _add_common(parser, CAN232_FAULTS)
        _add_can232(parser)
    else:
        _add_common(parser, USB2CAN_FAULTS)
        _add_usb2can(parser)


def _add_common(parser: argparse.ArgumentParser, faults: Sequence[str]) -> None:
    add = parser.add_argument
    host = parser.add_mutually_exclusive_group()
    host.add_argument(
        "--link",
        type=Path,
        metavar="PATH",
        help="symbolic link to the terminal, made now, removed at the end",
    )
    host.add_argument(
        "--line",
        metavar="PATH|unix:PATH",
        help="the host is on this existing device, or listens on this socket, instead of on a new terminal",
    )
    add("--bus", metavar="IFACE", help="SocketCAN interface on its CAN side, as vcan1")
    add(
        "--traffic",
        type=positive,
        default=0.0,
        metavar="FPS",
        help="frames a second from a made-up bus: ten identifiers, each with its period and a counter",
    )
    add("--mixed", action="store_true", help="instead of ten identifiers random frames of all kinds")
    add(
        "--count",
        type=_whole,
        metavar="N",
        help="the made-up bus carries N frames in all, none while the channel is not open",
    )
    add(
        "--processing",
        type=positive,
        default=0.0,
        metavar="SECONDS",
        help="time the device takes for a command",
    )
    add(
        "--record",
        type=Path,
        metavar="FILE",
        help="what the device puts on its bus, as 123#1122 in each line",
    )
    add("--state", type=Path, metavar="FILE", help="counters as JSON, written at the end and on SIGUSR1")
    fault = functools.partial(parse_fault, kinds=faults)
    kinds = "; ".join(f"{kind}: {MEANINGS[kind]}" for kind in faults)
    text = f"KIND@START[+DURATION] in seconds, may be repeated. {kinds}"
    add("--fault", type=fault, action="append", default=[], metavar="SPEC", help=text)
    add("--seed", type=int, default=0, metavar="N", help="of traffic and garbage")


def _add_can232(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--uart-rate",
        type=_whole,
        metavar="BAUD",
        help="pace the line at this rate; default: as fast as it goes",
    )
    version = _matching(r"V\d{4}", "a version like V1324")
    add("--version", type=version, default="V1324", dest="device_version", metavar="V", help="answer to V")
    serial = _matching(r"[0-9A-Z]{4}", "a serial number like A123")
    add("--serial-number", type=serial, default="A123", metavar="N", help="answer to N, without the N")
    add("--eeprom", type=Path, metavar="FILE", help="keeps the EEPROM and its write count, as JSON")
    add("--precise", action="store_true", help="busy-wait for exact timing (uses a whole core)")


def _add_usb2can(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    version = _matching(r"HW\d{4}FW\d{4}", "a version like HW0003FW0016")
    add(
        "--version",
        type=version,
        default="HW0003FW0016",
        dest="device_version",
        metavar="HWxxxxFWyzzz",
        help="answer to FW_VERSION; y: 5 and 6 stamp what they receive",
    )
    add(
        "--tx-buffer",
        type=_whole,
        default=20,
        metavar="FRAMES",
        help="room for frames to be sent; default: 20",
    )
    parser.set_defaults(eeprom=None, precise=False)


def _make_device(args: argparse.Namespace) -> tuple[Can232 | Usb2can, str]:
    """The device, and what it is called."""
    now = time.monotonic()
    version = args.device_version
    if args.adapter == "can232":
        can232 = Can232(
            now,
            eeprom=load_eeprom(args.eeprom),
            uart=Uart(args.uart_rate),
            version=version,
            serial_number=args.serial_number,
            processing_s=args.processing,
        )
        return can232, f"CAN232 {args.serial_number}"
    from bridged.simulators.usb2can import Usb2can  # noqa: PLC0415 - only the adapter in use is loaded

    usb2can = Usb2can(
        now,
        version=version,
        processing_s=args.processing,
        tx_buffer=args.tx_buffer,
        stop_grace_s=STOP_GRACE_S,
    )
    return usb2can, f"USB2CAN {version}"


def run(args: argparse.Namespace) -> int:
    """Simulate until SIGTERM or SIGINT, then return 0; PortError, BusError if an end cannot be had."""
    if args.count and not args.traffic:
        raise BridgeError("--count is a number of frames of --traffic, which is not there")
    device, name = _make_device(args)
    for path in (args.link, args.state, args.eeprom, args.record):
        if path and not path.parent.is_dir():
            raise PortError(f"{path}: there is no directory {path.parent}")
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(open_can(args.bus)) if args.bus else None
        try:
            record = stack.enter_context(args.record.open("wb", buffering=0)) if args.record else None
        except OSError as error:
            raise PortError(f"{args.record}: cannot be written: {error.strerror}") from error
        simulator = Simulator(
            device,
            link=args.link,
            line=args.line,
            bus=bus,
            record=record,
            traffic_fps=args.traffic,
            traffic=None if args.mixed else cyclic_frames(random.Random(args.seed)),
            traffic_count=args.count,
            faults=args.fault,
            rng=random.Random(args.seed),
            precise=args.precise,
            eeprom_file=args.eeprom,
            state_file=args.state,
        )
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: simulator.stop())
        signal.signal(signal.SIGUSR1, lambda *_: simulator.request_state())
        print(f"{name} on {args.link or simulator.port}", flush=True)
        simulator.run()
    return 0
