"""The command can-bridge."""

from __future__ import annotations

import argparse
import gc
import logging
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bridged.errors import BridgeError, ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged.config import Config

EX_CONFIG = 78  # sysexits.h
WATCH_INTERVAL_S = 1.0
EXIT_NOT_RUNNING = 3  # as systemctl status
CONFIG_DIRECTORY = Path("/etc/can-bridge")
HELP_WIDTH = 98


def config_path(name: str) -> Path:
    """A file, or the NAME of one in /etc/can-bridge."""
    path = Path(name)
    if "/" in name or path.suffix in {".yaml", ".yml"} or os.path.isfile(name):  # noqa: PTH113 - False, whatever the name
        return path
    return CONFIG_DIRECTORY / f"{name}.yaml"


def _load(name: str) -> Config:
    from bridged.config import load  # noqa: PLC0415 - 20 ms that `status` need not pay

    return load(config_path(name))


def _import_msgspec() -> None:
    """Without typing_extensions, of which it needs nothing in this Python: 10 % of the time to the start."""
    if "msgspec" in sys.modules or "typing_extensions" in sys.modules:
        return
    sys.modules["typing_extensions"] = None  # type: ignore[assignment] # documented: not to be found
    try:
        import msgspec  # noqa: F401, PLC0415
    finally:
        del sys.modules["typing_extensions"]


def _run(args: argparse.Namespace) -> int:
    gc.disable()  # until all is loaded, which makes no garbage to look for: 5 % of the time to the start
    _import_msgspec()

    from bridged.bridge import Bridge  # noqa: PLC0415
    from bridged.journal import start_logging  # noqa: PLC0415
    from bridged.memory import FileMemory, state_directory  # noqa: PLC0415
    from bridged.notify import systemd_notifier  # noqa: PLC0415
    from bridged.service import Service, hangup_means_reload  # noqa: PLC0415
    from bridged.status import StatusServer, own_socket_path, render  # noqa: PLC0415

    config = _load(args.config)
    notifier = systemd_notifier()
    fields = start_logging(config.name, verbose=args.verbose)
    memory = FileMemory(state_directory())

    def successor(present: Config) -> Bridge | None:
        fresh = _load(args.config)
        return None if fresh == present else Bridge(fresh, memory)

    def snapshot() -> dict[str, Any]:
        return service.bridge.snapshot()  # of the present one

    service = Service(Bridge(config, memory), notifier, successor if hangup_means_reload() else None)
    fields.state = lambda: service.bridge.state.value
    status = StatusServer(args.socket or own_socket_path(config.name), snapshot)
    gc.freeze()  # what is loaded stays
    gc.enable()
    try:
        service.run(status)
    finally:
        status.close()
    logging.getLogger(__name__).info("%s", render(snapshot()).replace("\n ", ";"))
    return 0


def _check(args: argparse.Namespace) -> int:
    config = _load(args.config)
    adapter, channel, bus = config.adapter, config.channel, config.bus
    rate = f" at {adapter.baudrate} Bd" if adapter.type == "can232" else ""
    print(
        f"{config.path}: good: {adapter.type} on {adapter.port}{rate}, "
        f"{channel.timing.description}{', listen-only' if channel.listen_only else ''}, "
        f"to {bus.interface} {bus.channel}"
    )
    return 0


def _status_path(args: argparse.Namespace) -> Path:
    from bridged.status import StatusError, running_sockets, runtime_directory  # noqa: PLC0415

    if args.socket:
        return Path(args.socket)
    running = running_sockets()
    if args.name:
        name = config_path(args.name).stem
        return next((path for path in running if path.stem == name), runtime_directory() / f"{name}.sock")
    if len(running) == 1:
        return running[0]
    names = ", ".join(path.stem for path in running)
    raise StatusError(
        f"several bridges are running, name one: {names}" if running else "no bridge is running"
    )


def _status(args: argparse.Namespace) -> int:
    import json  # noqa: PLC0415

    from bridged.status import query, render  # noqa: PLC0415

    path = _status_path(args)
    clear = "\x1b[H\x1b[J" if args.watch and not args.json and sys.stdout.isatty() else ""
    while True:
        status = query(path)
        text = json.dumps(status, indent=None if args.watch else 2) if args.json else render(status)
        print(f"{clear}{text}", flush=True)
        if not args.watch:
            break
        time.sleep(WATCH_INTERVAL_S)
    return 0 if status["state"] == "running" and status["bus"]["open"] else EXIT_NOT_RUNNING


def _parser(command: str | None) -> argparse.ArgumentParser:
    """The parser; only `command` gets its options, since those of a simulator cost its import."""

    def formatter(prog: str) -> argparse.HelpFormatter:
        """With the terminal's width argparse would load shutil, and that the compression libraries: 5 ms."""
        return argparse.HelpFormatter(prog, width=HELP_WIDTH)

    parser = argparse.ArgumentParser(
        "can-bridge", description="Serial CAN adapters as Linux CAN interfaces.", formatter_class=formatter
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, text: str, run: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text, formatter_class=formatter)
        sub.set_defaults(run=run)
        return sub

    run = add("run", "Run the bridge of a configuration in the foreground.", _run)
    run.add_argument(
        "config", metavar="FILE|NAME", help=f"YAML file, or NAME for {CONFIG_DIRECTORY}/NAME.yaml"
    )
    run.add_argument("--socket", type=Path, metavar="PATH", help="where the status socket is made")
    run.add_argument(
        "--verbose", action="store_true", help="log what is only of interest when looking for a fault"
    )

    check = add("check", "Check a configuration; exit status 78 if it is not good.", _check)
    check.add_argument("config", metavar="FILE|NAME")

    status = add(
        "status", "Show the state and the counters of a running bridge; exit status 0 if it runs.", _status
    )
    status.add_argument("name", nargs="?", metavar="NAME", help="stem of the configuration's file name")
    status.add_argument("--socket", metavar="PATH", help="the status socket, if not at its usual place")
    status.add_argument("--json", action="store_true")
    status.add_argument("--watch", action="store_true", help="again each second, until Ctrl-C")

    simulate = add(
        "simulate", "Simulate an adapter on a pseudo terminal, or on a line that is there.", _simulate
    )
    if command == "simulate":
        from bridged.simulators import commands as simulators  # noqa: PLC0415

        kinds = simulate.add_subparsers(dest="kind", required=True, metavar="ADAPTER")
        for adapter, text in simulators.ADAPTERS.items():
            simulators.add_arguments(kinds.add_parser(adapter, help=text), adapter)

    demo = add("demo", "Show a simulated adapter at work on a CAN interface.", _demo)
    if command == "demo":
        from bridged.demo import add_arguments  # noqa: PLC0415

        add_arguments(demo)
    return parser


def _simulate(args: argparse.Namespace) -> int:
    from bridged.simulators import commands  # noqa: PLC0415

    return commands.run(args)


def _demo(args: argparse.Namespace) -> int:
    from bridged import demo  # noqa: PLC0415

    return demo.run(args)


def main(argv: list[str] | None = None) -> int:
    """Entry point. Exit status: 0 done, 1 failed, 3 the bridge is not running, 78 bad configuration."""
    arguments = sys.argv[1:] if argv is None else argv
    args = _parser(arguments[0] if arguments else None).parse_args(arguments)
    try:
        return int(args.run(args))
    except ConfigError as error:
        print(error, file=sys.stderr)
        return EX_CONFIG
    except BridgeError as error:
        print(f"can-bridge: {error}", file=sys.stderr)
        return EXIT_NOT_RUNNING if args.command == "status" else 1
    except BrokenPipeError:
        return 1
    except KeyboardInterrupt:  # before the handlers were there
        return 130
