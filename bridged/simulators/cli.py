"""`can-bridge simulate`: the options that all simulators have, and one of them until a signal ends it."""

from __future__ import annotations

import contextlib
import functools
import random
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

from bridged.errors import BridgeError, PortError
from bridged.simulators import faults, simulator
from bridged.simulators.ends import open_can
from bridged.simulators.options import positive, whole
from bridged.simulators.serve import Simulator, cyclic_frames

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping


def add_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    """The options of `can-bridge simulate NAME`."""
    module = simulator(name)
    parser.set_defaults(simulator=name, eeprom=None, precise=False)
    _add_common(parser, faults.meanings(module.FAULTS))
    module.add_arguments(parser)


def _add_common(parser: argparse.ArgumentParser, meanings: Mapping[str, str]) -> None:
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
        type=whole,
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
    fault = functools.partial(faults.parse_fault, kinds=meanings)
    kinds = "; ".join(f"{kind}: {meaning}" for kind, meaning in meanings.items())
    text = f"KIND@START[+DURATION] in seconds, may be repeated. {kinds}"
    add("--fault", type=fault, action="append", default=[], metavar="SPEC", help=text)
    add("--seed", type=int, default=0, metavar="N", help="of traffic and garbage")


def run(args: argparse.Namespace) -> int:
    """Simulate until SIGTERM or SIGINT, then return 0; PortError, InterfaceError if an end cannot be had."""
    if args.count and not args.traffic:
        raise BridgeError("--count is a number of frames of --traffic, which is not there")
    device = simulator(args.simulator).make_device(time.monotonic(), args)
    for path in (args.link, args.state, args.eeprom, args.record):
        if path and not path.parent.is_dir():
            raise PortError(f"{path}: there is no directory {path.parent}")
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(open_can(args.bus)) if args.bus else None
        try:
            record = stack.enter_context(args.record.open("wb", buffering=0)) if args.record else None
        except OSError as error:
            raise PortError(f"{args.record}: cannot be written: {error.strerror}") from error
        simulated = Simulator(
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
            signal.signal(number, lambda *_: simulated.stop())
        signal.signal(signal.SIGUSR1, lambda *_: simulated.request_state())
        print(f"{device.title} on {args.link or simulated.port}", flush=True)
        simulated.run()
    return 0
