"""The command can-bridge."""

from __future__ import annotations

import argparse
import errno
import gc
import io
import logging
import os
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bridged import VERSION
from bridged.errors import BridgeError, ConfigError, InterfaceError
from bridged.text import printable

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridged.interfaces.base import OpenInterface
    from bridged.overlay import Setting
    from bridged.ports import Port
    from bridged.settings import BusConfig, Config

EX_CONFIG = 78  # sysexits.h
WATCH_INTERVAL_S = 1.0
EXIT_NOT_RUNNING = 3  # as systemctl status
PROBES = ("started", "ready", "live")  # see daemon/probes.py
CONFIG_DIRECTORY = Path("/etc/can-bridge")
DEFAULT_NAME = "can-bridge"  # of a configuration
HELP_WIDTH = 98
RUN_OPTIONS = {
    "--socket",
    "--user",
    "--verbose",
    "--capture",
    "--mask",
    "--capture-limit",
}  # all others are keys
MEGABYTES_MAX = 10_000  # of a capture
OUTPUT_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
COMMAND_LINE = "the command line"  # instead of a file: as in yaml_source.py, which costs imports
CANNOT_WRITE = "cannot write to the standard output: {}"


def config_path(name: str) -> Path:
    """A file, or the NAME of one in /etc/can-bridge."""
    return Path(name) if _is_file(name) else CONFIG_DIRECTORY / f"{name}.yaml"


def _is_file(name: str) -> bool:
    """Whether it names a file by its path, there or not."""
    return "/" in name or Path(name).suffix in {".yaml", ".yml"} or os.path.isfile(name)  # noqa: PTH113 - False, whatever the name


def _load(name: str) -> Config:
    from bridged.config import load  # noqa: PLC0415 - 20 ms that `status` need not pay

    return load(_existing(name), os.environ)


def _existing(name: str) -> Path:
    """The path of a configuration; if there is none, ConfigError with the one that is probably meant.

    Where the environment has settings, there need be no file.
    """
    path = config_path(name)
    try:
        path.stat()
    except FileNotFoundError:
        if _variables():
            return path
        near = [path.with_suffix(suffix) for suffix in (".yaml", ".yml")]
        near += [path.with_name(f"{path.name}.yaml"), CONFIG_DIRECTORY / f"{path.stem}.yaml"]
        found = next((str(file) for file in near if file.is_file()), None)
        if found is None and path.parent == CONFIG_DIRECTORY:
            found = ", ".join(sorted(file.stem for file in CONFIG_DIRECTORY.glob("*.yaml")))
        there = f"; there is {found}" if found else ", and no environment variable CAN_BRIDGE__SECTION__KEY"
        raise ConfigError([f"{path}: there is no such file{there}"]) from None
    except OSError:  # reading says why
        pass
    return path


def _variables() -> list[str]:
    """The names of the environment variables that are settings."""
    from bridged.environment import variables  # noqa: PLC0415 - as above

    return variables(os.environ)


def _source(path: Path) -> str:
    """Where a configuration comes from, for the user."""
    is_given = str(path) == COMMAND_LINE or os.path.exists(path)  # noqa: PTH110 - False, whatever
    return ", ".join([*[str(path)] * is_given, *_variables()])


def _import_msgspec() -> None:
    """Without typing_extensions, of which it needs nothing in this Python: 10 % of the time to the start."""
    if "msgspec" in sys.modules or "typing_extensions" in sys.modules:
        return
    sys.modules["typing_extensions"] = None  # type: ignore[assignment] # documented: not to be found
    try:
        import msgspec  # noqa: F401, PLC0415
    finally:
        del sys.modules["typing_extensions"]


def _end_before_start(*_: object) -> None:
    raise SystemExit(0)


def _run(args: argparse.Namespace) -> int:
    # Until Service has its own: process 1 of a container gets no signal without a handler, and SIGKILL would
    # follow when the adapter's channel is open.
    signal.signal(signal.SIGTERM, _end_before_start)
    gc.disable()  # until all is loaded, which makes no garbage to look for: 5 % of the time to the start
    _import_msgspec()

    from bridged.bridge.bridge import Bridge  # noqa: PLC0415
    from bridged.daemon.config_map import MountedConfig  # noqa: PLC0415
    from bridged.daemon.directories import state_directory  # noqa: PLC0415
    from bridged.daemon.eeprom_store import FileMemory  # noqa: PLC0415
    from bridged.daemon.journal import start_logging  # noqa: PLC0415
    from bridged.daemon.notify import systemd_notifier  # noqa: PLC0415
    from bridged.daemon.service import Service, hangup_means_reload  # noqa: PLC0415
    from bridged.daemon.status import StatusServer, own_socket_path  # noqa: PLC0415
    from bridged.daemon.status_text import farewell  # noqa: PLC0415
    from bridged.interfaces import open_interface  # noqa: PLC0415

    mounted = None if args.settings else MountedConfig(config_path(args.config or DEFAULT_NAME))
    config = _given(args)
    from_file = config.path.exists()
    port_opener = _port_opener(args, config)
    open_interface = _opened_as(args.user, config.bus) if args.user else open_interface
    notifier = systemd_notifier()
    fields = start_logging(config.name, verbose=args.verbose)
    log = logging.getLogger(__name__)
    adapter, bus = config.adapter, config.bus
    log.info(
        "can-bridge %s: %s: %s on %s to %s %s",
        VERSION, _source(config.path), adapter.type, adapter.port, bus.interface, bus.channel,
    )  # fmt: skip
    if args.capture:
        masked = ", with other identifiers and without data" if args.mask else ""
        log.info("capture: all bytes from and to the adapter are written to %s%s", args.capture, masked)
    memory = FileMemory(state_directory())

    def successor(present: Config) -> Bridge | None:
        fresh = _given_anew(args, from_file=from_file)
        return None if fresh == present else Bridge(fresh, memory, open_port=port_opener(fresh))

    def snapshot() -> dict[str, Any]:
        return {"version": VERSION, **service.bridge.snapshot()}  # of the present one

    first = Bridge(config, memory, open_port=port_opener(config), open_interface=open_interface)
    service = Service(first, notifier, successor if hangup_means_reload() else None, mounted)
    fields.state = lambda: service.bridge.state.value
    status = StatusServer(args.socket or own_socket_path(config.name), snapshot)
    gc.freeze()  # what is loaded stays
    gc.enable()
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # after run(): one that comes late does not spoil a good end
    try:
        service.run(status)
    finally:
        status.close()
    log.info("%s", farewell(snapshot()))
    return 0


def _given(args: argparse.Namespace) -> Config:
    """The configuration that `run` is given: a file's, or that of its options."""
    if not args.settings:
        return _load(args.config or DEFAULT_NAME)
    from bridged.config import load_options  # noqa: PLC0415 - as above
    from bridged.overlay import Setting  # noqa: PLC0415

    settings = list(args.settings)
    if args.config is not None:
        if Path(args.config).suffix in {".yaml", ".yml"}:
            text = f"{args.config}: a file is not read where options are keys ({settings[0].name}): "
            raise ConfigError([f"{text}change the file, or name the interface instead"])
        settings.append(Setting("INTERFACE", ("bus", "channel"), args.config))
    return load_options(settings, os.environ)


def _given_anew(args: argparse.Namespace, *, from_file: bool) -> Config:
    """The configuration for a reload; `from_file`: the first one was, maybe with variables laid over it."""
    if args.settings:
        raise ConfigError(["there is no file to read again, the options hold: start the bridge anew"])
    config = _given(args)
    if from_file and not config.path.exists():
        # The variables alone may be a whole configuration, but without what only the file says: listen_only.
        raise ConfigError([f"{config.path}: there is no such file any more"])
    return config


def _port_opener(args: argparse.Namespace, config: Config) -> Callable[[Config], Callable[[str, int], Port]]:
    """How a bridge opens its ports, by its configuration: with --capture all that goes through is written."""
    if args.capture:
        from bridged.capture import LIMIT_MB, MB, Capture  # noqa: PLC0415 - only where it is asked for

        limit = (args.capture_limit or LIMIT_MB) * MB
        return Capture(args.capture, config, masked=args.mask, limit=limit).opener
    if args.mask or args.capture_limit:
        raise BridgeError("--mask and --capture-limit are for --capture FILE, which is not there")
    from bridged.ports import open_port  # noqa: PLC0415 - 20 ms that `status` need not pay

    return lambda _: open_port


def _opened_as(user: str, bus: BusConfig) -> Callable[..., OpenInterface]:
    """Becomes `user`; before that opens the interface: it takes root to make it, and to enlarge its buffer.

    The function returned gives the open interface, or the error, when it is called the first time.
    """
    from bridged.daemon.privileges import become  # noqa: PLC0415
    from bridged.interfaces import open_interface  # noqa: PLC0415

    opened: list[OpenInterface | InterfaceError] = []
    if bus.interface == "socketcan":  # python-can's need no privilege, and may have threads
        try:
            opened.append(open_interface(bus.interface, bus.channel, create=bus.create, options=bus.options))
        except InterfaceError as error:
            opened.append(error)
    become(user)

    def opened_before(*arguments: Any, **options: Any) -> OpenInterface:
        if not opened:
            return open_interface(*arguments, **options)
        found = opened.pop()
        if isinstance(found, InterfaceError):
            raise found
        return found

    return opened_before


def _interface(args: argparse.Namespace) -> int:
    channel = args.name
    if channel is None or _is_file(channel) or config_path(channel).is_file():
        config = _load(channel or DEFAULT_NAME)
        channel = config.bus.channel
        if not config.bus.create:
            print(f"{channel}: not made, since {printable(_source(config.path))} does not say create: true")
            return 0
    from bridged.interfaces.socketcan import make_interface  # noqa: PLC0415

    made = make_interface(channel)
    print(f"{printable(channel)}: {'is up' if made else 'was up before'}")
    return 0


def _check(args: argparse.Namespace) -> int:
    names = (
        args.config
        or sorted(map(str, CONFIG_DIRECTORY.glob("*.yaml")))
        or [DEFAULT_NAME] * bool(_variables())
    )
    if not names:
        raise ConfigError([f"{CONFIG_DIRECTORY}: there is no configuration, NAME.yaml: name a file"])
    problems: list[str] = []
    for name in names:
        try:
            _check_one(Path("/dev/stdin") if name == "-" else _existing(name))
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(problems)
    return 0


def _check_one(path: Path) -> None:
    from bridged.config import check  # noqa: PLC0415 - as above

    config, warnings = check(path, os.environ)
    for warning in warnings:
        print(printable(warning), file=sys.stderr)
    adapter, channel, bus = config.adapter, config.channel, config.bus
    print(
        f"{printable(_source(config.path))}: OK: {adapter.type} on {adapter.where}, "
        f"{channel.timing.description}{', listen-only' if channel.listen_only else ''}, "
        f"to {bus.interface} {bus.channel}"
    )
    for note in adapter.notes(channel):
        print(f"  {note}")


def _status_paths(args: argparse.Namespace) -> list[Path]:
    """The status sockets to ask; NotRunningError: there is none."""
    from bridged.daemon.status import NotRunningError, running_sockets  # noqa: PLC0415

    if args.socket:
        return [Path(args.socket)]
    running = running_sockets()
    if not args.name:
        if not running:
            raise NotRunningError(f"no bridge is running{_seen()}: start one with `can-bridge run NAME`")
        return running
    name = config_path(args.name).stem
    found = [path for path in running if path.stem == name]
    if not found:
        raise NotRunningError(_not_running(args.name))
    return found[:1]


def _seen() -> str:
    return "" if os.geteuid() == 0 else " (only your bridges and root's are seen)"


def _not_running(name: str) -> str:
    """What to do about the bridge NAME that does not run."""
    path = config_path(name)
    if not os.path.isfile(path):  # noqa: PTH113 - False, whatever the name
        return f"{path.stem} is not running{_seen()}, and there is no {path}"
    start = f"`can-bridge run {name}`"
    if path.parent == CONFIG_DIRECTORY:
        start += f" or `systemctl start can-bridge@{path.stem}`"
    return f"{path.stem} is not running{_seen()}: start it with {start}"


def _ask(args: argparse.Namespace) -> tuple[str, bool]:
    """What to show, and whether all bridges that were asked run."""
    import json  # noqa: PLC0415

    from bridged.daemon.status import NotRunningError, StatusError, is_running  # noqa: PLC0415
    from bridged.daemon.status_text import render, render_short  # noqa: PLC0415

    paths = _status_paths(args)
    if len(paths) == 1:
        try:
            status = _query(paths[0])
        except NotRunningError as error:
            if args.socket:
                raise
            raise NotRunningError(_not_running(args.name or paths[0].stem)) from error
        text = json.dumps(status, indent=None if args.watch else 2) if args.json else render(status)
        return text, is_running(status)
    lines, all_run = [], True
    for path in paths:
        try:
            status = _query(path)
            lines.append(json.dumps(status) if args.json else render_short(status))
            all_run = all_run and is_running(status)
        except StatusError as error:
            all_run = False
            if args.json:
                _complain(f"{path.stem}: {error}")
            else:
                lines.append(printable(f"{path.stem}: {error}"))
    return "\n".join(lines), all_run


def _query(path: Path) -> dict[str, Any]:
    """As query(); root of a container that has few capabilities asks as the socket's owner, if need be."""
    from bridged.daemon.status import StatusError, query  # noqa: PLC0415

    try:
        return query(path)
    except StatusError as error:
        if os.geteuid() != 0 or not isinstance(error.__cause__, PermissionError):
            raise
        from bridged.daemon.privileges import acting_as_owner  # noqa: PLC0415

        try:
            with acting_as_owner(path):
                return query(path)
        except OSError:
            raise error from None


def _status(args: argparse.Namespace) -> int:
    if args.check:
        return _probe(args)
    if args.watch:
        return _watch(args)
    text, all_run = _ask(args)
    print(text)
    return 0 if all_run else EXIT_NOT_RUNNING


def _probe(args: argparse.Namespace) -> int:
    """One line for each bridge; 0: it holds for all, 1: not for one that answers, 3: one does not answer."""
    from bridged.daemon.probes import answer  # noqa: PLC0415
    from bridged.daemon.status import StatusError  # noqa: PLC0415

    statuses = {0}
    for path in _status_paths(args):
        try:
            holds, line = answer(args.check, _query(path))
        except StatusError as error:
            line = printable(f"{path.stem}: not {args.check}: {error}")
            statuses.add(EXIT_NOT_RUNNING)
        else:
            statuses.add(0 if holds else 1)
        print(line)
    return max(statuses)


def _watch(args: argparse.Namespace) -> int:
    """Until Ctrl-C; a bridge that is not there, or does not answer, is waited for."""
    from bridged.daemon.status import NoAnswerError  # noqa: PLC0415

    screen = not args.json and sys.stdout.isatty()
    missed = ""
    while True:
        try:
            text, _ = _ask(args)
            missed = ""
        except NoAnswerError as error:
            text = "" if args.json else f"{printable(str(error))}; waiting for it"
            if args.json and str(error) != missed:
                _complain(f"{error}; waiting for it")
                missed = str(error)
        if screen:
            print(f"\x1b[H\x1b[J{_fitted(text)}", flush=True)
        elif text:
            print(text, flush=True)
        time.sleep(WATCH_INTERVAL_S)


def _fitted(text: str) -> str:
    """Its first lines that fit into the terminal: one more would push out the first, with the state."""
    try:
        columns, rows = os.get_terminal_size(sys.stdout.fileno())
    except OSError:
        return text
    if not columns or not rows:  # a serial console
        return text
    folded = [line[at : at + columns] for line in text.splitlines() for at in range(0, len(line), columns)]
    return "\n".join(folded[: max(1, rows - 1)])


def _complain(text: str) -> None:
    print(f"can-bridge: {printable(text)}", file=sys.stderr)


def _megabytes(text: str) -> int:
    """An option's value."""
    if text.isdecimal() and 0 < int(text) <= MEGABYTES_MAX:
        return int(text)
    raise argparse.ArgumentTypeError(f"expected a whole number from 1 to {MEGABYTES_MAX}, got {text!r}")


def _parser(arguments: list[str]) -> argparse.ArgumentParser:
    """The parser; only the command, and the simulator, that is named gets its options: they cost imports."""
    command = arguments[0] if arguments else None

    def formatter(prog: str) -> argparse.HelpFormatter:
        """With the terminal's width argparse would load shutil, and that the compression libraries: 5 ms."""
        return argparse.HelpFormatter(prog, width=HELP_WIDTH)

    parser = argparse.ArgumentParser(
        "can-bridge", description="Serial CAN adapters as Linux CAN interfaces.", formatter_class=formatter
    )
    parser.add_argument("--version", action="version", version=f"can-bridge {VERSION}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, text: str, run: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
        # Options that are keys are not for argparse: an abbreviated one would be passed over.
        sub = commands.add_parser(
            name, help=text, description=text, formatter_class=formatter, allow_abbrev=name != "run"
        )
        sub.set_defaults(run=run)
        return sub

    run = add("run", "Run the bridge of a configuration in the foreground.", _run)
    run.set_defaults(settings=[])
    run.add_argument(
        "config",
        nargs="?",
        metavar="FILE|NAME|INTERFACE",
        help=f"YAML file, or NAME for {CONFIG_DIRECTORY}/NAME.yaml; default: {DEFAULT_NAME}; none is needed "
        "where the environment has all: CAN_BRIDGE__ADAPTER__PORT is the key port of section adapter. "
        "With options that are keys: the interface, as vcan0",
    )
    run.add_argument(
        "--socket",
        type=Path,
        metavar="PATH",
        help="where the status socket is made; default: /run/can-bridge/NAME.sock for root, "
        "$XDG_RUNTIME_DIR/can-bridge/NAME.sock for others",
    )
    run.add_argument(
        "--user",
        metavar="USER",
        help="a name or a number: as root, make and open the interface, then become this user and keep no "
        "privilege (for a container that starts as root)",
    )
    run.add_argument("--verbose", action="store_true", help="log details (debugging)")
    run.add_argument(
        "--capture",
        type=Path,
        metavar="FILE",
        help="for bug reports: all bytes from and to the adapter are written to this new file, as text",
    )
    run.add_argument(
        "--mask",
        action="store_true",
        help="with --capture: identifiers become others, the same always the same, and data becomes zeros",
    )
    run.add_argument(
        "--capture-limit",
        type=_megabytes,
        metavar="MB",
        help="the capture ends when its file has so many megabytes; default: 16",
    )

    if command == "run" and _has_other_options(arguments):
        _describe_keys(run)

    interface = add(
        "interface",
        "Make a virtual CAN interface, bring it up, and end; needs CAP_NET_ADMIN only.",
        _interface,
    )
    interface.add_argument(
        "name",
        nargs="?",
        metavar="INTERFACE|FILE|NAME",
        help="its name, such as vcan0; or a configuration, as for run: its interface is made if the file "
        "says create: true",
    )

    check = add(
        "check", "Check configurations; exit status 78 if one cannot be used, 0 also with warnings.", _check
    )
    check.add_argument(
        "config",
        nargs="*",
        metavar="FILE|NAME",
        help=f"- is the standard input; default: all of {CONFIG_DIRECTORY}",
    )

    status = add(
        "status",
        "Show the state and the counters of running bridges; exit status 0 if all of them run, 3 if not.",
        _status,
    )
    status.add_argument(
        "name",
        nargs="?",
        metavar="NAME",
        help=f"as in {CONFIG_DIRECTORY}/NAME.yaml; without it all bridges that run, several with a line each",
    )
    status.add_argument("--socket", metavar="PATH", help="the status socket, if not at its usual place")
    status.add_argument(
        "--json",
        action="store_true",
        help="print JSON, for programs: an object for each bridge, in one line if there are several",
    )
    status.add_argument(
        "--check",
        choices=PROBES,
        help="a probe, one line: started (the interface is up, adapter or not), ready (frames pass), live "
        "(the process turns, adapter or not); exit status 0 yes, 1 no, 3 no bridge answers",
    )
    status.add_argument(
        "--watch",
        action="store_true",
        help="again each second, until Ctrl-C; a bridge that does not run is waited for",
    )

    listing = add(
        "list",
        "List the serial ports and USB devices that could be an adapter; opens none of them.",
        _list,
    )
    listing.add_argument("--json", action="store_true", help="print JSON, for programs: a list of objects")

    simulate = add(
        "simulate", "Simulate an adapter on a pseudo terminal, or on an existing device or socket.", _simulate
    )
    if command == "simulate":
        from bridged.simulators import SIMULATORS, simulator  # noqa: PLC0415
        from bridged.simulators.cli import add_arguments as add_simulator  # noqa: PLC0415

        kinds = simulate.add_subparsers(dest="kind", required=True, metavar="ADAPTER")
        named = [name for name in arguments[1:2] if name in SIMULATORS]
        for name in named or SIMULATORS:
            add_simulator(kinds.add_parser(name, help=simulator(name).TITLE), name)

    demo = add("demo", "Show a simulated adapter at work on a CAN interface.", _demo)
    if command == "demo":
        from bridged.demo import add_arguments as add_demo  # noqa: PLC0415

        add_demo(demo)
    return parser


def _list(args: argparse.Namespace) -> int:
    from bridged import listing  # noqa: PLC0415

    return listing.run(args)


def _describe_keys(run: argparse.ArgumentParser) -> None:
    """For --help; options.py takes them from the arguments before."""
    from bridged.adapters import TYPES  # noqa: PLC0415

    group = run.add_argument_group(
        "without a file",
        "Every key of a file is an option, --SECTION.KEY VALUE, or --KEY where only one section has it; the "
        "value is YAML. The usual ones:",
    )
    group.add_argument("--type", metavar="TYPE", help=f"of the adapter: {' or '.join(TYPES)}")
    group.add_argument("--port", metavar="PORT", help="as `can-bridge list` shows it: a path or a URL")
    group.add_argument("--baudrate", metavar="BAUD", help="of the serial line, in bit/s")
    group.add_argument("--bitrate", metavar="BITRATE", help="of the CAN bus, in bit/s")
    group.add_argument("--listen-only", action="store_true", help="hear everything, send nothing")
    group.add_argument(
        "--create", action="store_true", help="make the interface if it is missing; needs root"
    )


def _has_other_options(arguments: list[str]) -> bool:
    """Whether there are options that may be keys, or ask for help: a start with a file does without them."""
    options = {argument.partition("=")[0] for argument in arguments if argument.startswith("-")}
    return not options <= RUN_OPTIONS


def _take_keys(arguments: list[str]) -> tuple[list[Setting], list[str]]:
    """The options of `run` that are keys of a configuration, and the other arguments."""
    if arguments[:1] != ["run"] or not _has_other_options(arguments):
        return [], arguments
    _import_msgspec()
    from bridged.config import keys  # noqa: PLC0415 - only where there are any
    from bridged.options import take  # noqa: PLC0415

    return take(arguments, keys())


def _simulate(args: argparse.Namespace) -> int:
    from bridged.simulators import cli as commands  # noqa: PLC0415

    return commands.run(args)


def _demo(args: argparse.Namespace) -> int:
    from bridged import demo  # noqa: PLC0415

    return demo.run(args)


def main(argv: list[str] | None = None) -> int:
    """Entry point. Exit status: 0 done, 1 failed, 3 the bridge is not running, 78 bad configuration."""
    _mend_standard_streams()
    try:
        status = _perform(sys.argv[1:] if argv is None else argv)
    except SystemExit:  # argparse has said what it is asked for, or what is wrong
        if _flush():
            raise
        return 1
    return status if _flush() else 1


def _perform(arguments: list[str]) -> int:
    command = arguments[0] if arguments else None
    try:
        settings, arguments = _take_keys(arguments)
        args = _parser(arguments).parse_args(arguments)
        if settings:
            args.settings = settings
        return int(args.run(args))
    except ConfigError as error:
        for problem in error.problems:
            print(printable(problem), file=sys.stderr)
        return EX_CONFIG
    except BridgeError as error:
        _complain(str(error))
        return EXIT_NOT_RUNNING if command == "status" else 1
    except BrokenPipeError:
        return 1
    except OSError as error:
        if command == "run" or error.errno not in OUTPUT_FULL or error.filename is not None:  # a bug
            raise
        _lead_nowhere(1)
        _complain(CANNOT_WRITE.format(error.strerror))
        return 1
    except KeyboardInterrupt:  # before the handlers were there
        return 130


def _mend_standard_streams() -> None:
    """Those that are closed lead nowhere, or the adapter's port might get the number of one of them.

    What the locale's encoding does not have is written as an escape, never a reason to fail.
    """
    for fd in (0, 1, 2):
        try:
            os.fstat(fd)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free
    sys.stdout = sys.stdout or os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", closefd=False)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _flush() -> bool:
    """Whether all that was printed is written: here it can be told, in the interpreter's end it cannot."""
    written = True
    try:
        sys.stdout.flush()
    except OSError as error:
        written = False
        _lead_nowhere(1)
        if not isinstance(error, BrokenPipeError):  # who does not read on has seen enough
            _complain(CANNOT_WRITE.format(error.strerror))
    try:
        sys.stderr.flush()
    except OSError:
        _lead_nowhere(2)
    return written


def _lead_nowhere(fd: int) -> None:
    """What waits in the stream's buffer is written there at the end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), fd)
