"""can-bridge@.service and the udev rules under a real systemd, sandbox and all.

They install themselves into the machine, so only in our own.
"""

import contextlib
import json
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from rig import DEADLINE_S, HOST, MONITOR, Chip, HostProcess, Rig, ask_monitor, wait_until

pytestmark = pytest.mark.timeout(600)

FILES = Path(__file__).parents[2] / "systemd"
UNIT = Path("/etc/systemd/system/can-bridge@.service")
START_RULES = Path("/etc/udev/rules.d/71-can-bridge-start.rules")
NAMED = Path("/dev/can-bridge")
STOP_LIMIT_S = 5.0  # TimeoutStopSec=
WATCHDOG_S = 10.0  # WatchdogSec=


def execute(*arguments: str | Path, status: int | None = 0) -> str:
    """A program's output; it must end with this exit status, if any."""
    done = subprocess.run(
        arguments,
        check=False,
        text=True,
        timeout=2 * DEADLINE_S,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert status is None or done.returncode == status, (
        f"{arguments}: status {done.returncode}\n{done.stdout}\n{execute('journalctl', '-n40', status=None)}"
    )
    return done.stdout.strip()


@pytest.fixture(scope="module", autouse=True)
def installed() -> None:
    """As systemd/README.md says."""
    if not MONITOR.exists():
        pytest.skip("only in our virtual machine: ./dev vm run")
    install(FILES)


def install(files: Path) -> None:
    """The commands of systemd/README.md, but for the start; all is in place when they end."""
    execute("udevadm", "settle")
    text = (FILES / "README.md").read_text()
    (block,) = re.findall(
        r"Then, in this directory, as root:\n\n```sh\n(.*?)systemctl enable", text, re.DOTALL
    )
    execute("sh", "-euc", f"cd {files}; {block}")
    execute("udevadm", "settle")


class Instance:
    """can-bridge@NAME with its configuration and an interface of its own, which it makes itself."""

    def __init__(self, name: str, interface: str) -> None:
        self.name, self.interface = name, interface
        self.unit = f"can-bridge@{name}.service"
        self.file = Path("/etc/can-bridge", f"{name}.yaml")
        self.socket = Path("/run/can-bridge", name, f"{name}.sock")
        self._since = f"@{time.time():.3f}"  # a cursor and matches together lose the first entry

    def configure(
        self, port: str | Path, *, adapter: str = "can232", create: bool = True, **transmit: Any
    ) -> None:
        settings: dict[str, Any] = {"type": adapter, "port": str(port)}
        if adapter == "can232":
            settings["baudrate"] = 115200
        self.file.parent.mkdir(exist_ok=True)
        self.file.write_text(
            yaml.safe_dump(
                {
                    "adapter": settings,
                    "channel": {"bitrate": 125000},
                    "bus": {"channel": self.interface, "create": create},
                    "transmit": {"deadline": 30.0} | transmit,
                }
            )
        )
        self.file.chmod(0o644)

    def systemctl(self, verb: str, status: int | None = 0) -> float:
        """How many seconds it took."""
        before = time.monotonic()
        execute("systemctl", verb, self.unit, status=status)
        return time.monotonic() - before

    def show(self, key: str) -> str:
        return execute("systemctl", "show", "-P", key, self.unit)

    @property
    def pid(self) -> int:
        return int(self.show("MainPID"))

    def wait_status(self, start: str) -> str:
        """Wait until `systemctl status` says something that begins like this."""
        seen = ""

        def says() -> bool:
            nonlocal seen
            seen = self.show("StatusText")
            return seen.startswith(start)

        try:
            wait_until(says, f"the status {start}")
        except AssertionError as error:
            raise AssertionError(f"{error}; it is {seen!r}\n{self.log()}") from None
        return seen

    def wait_for_another(self, pid: int) -> None:
        """Wait until systemd has started it again, and it runs."""
        wait_until(lambda: self.pid not in {0, pid}, "another process", 2 * DEADLINE_S)
        wait_until(lambda: self.show("ActiveState") == "active", "it to be ready")
        self.wait_status("running: ")

    def log(self, *matches: str) -> str:
        # Fields of the same entry, and what systemd says about the unit.
        matches = matches or ("-u", self.unit)
        return execute("journalctl", "-o", "cat", "--since", self._since, *matches, status=None)

    def clear(self) -> None:
        execute("systemctl", "stop", self.unit)
        execute("systemctl", "reset-failed", self.unit, status=None)
        self.file.unlink(missing_ok=True)
        execute("ip", "link", "delete", self.interface, status=None)
        print(self.log())


@pytest.fixture
def instance() -> Iterator[Callable[[str], Instance]]:
    made: list[Instance] = []

    def make(name: str) -> Instance:
        made.append(Instance(name, f"cbs{len(made)}"))
        return made[-1]

    yield make
    for one in made:
        one.clear()


@pytest.fixture
def can232(rig: Rig, instance: Callable[[str], Instance]) -> Iterator[Instance]:
    """An instance with a simulated CAN232 behind the chip ftdi0, as /dev/can-bridge/SERIAL; it runs."""
    chip = rig.chip("ftdi0")
    simulator = rig.host_simulate("--state", "systemd.json", adapter="can232")
    wait_until((NAMED / chip.serial_number).exists, "the name that stays")
    made = instance("can232")
    made.configure(NAMED / chip.serial_number)
    made.systemctl("start")
    made.wait_status("running: ")
    yield made
    made.systemctl("stop")
    assert read_state(simulator)["channel"] == "closed"


@contextlib.contextmanager
def drop_in(made: Instance, name: str) -> Iterator[None]:
    """One of our drop-ins for this instance; the next start takes it, or no longer."""
    folder = Path(f"/etc/systemd/system/{made.unit}.d")
    folder.mkdir()
    try:
        shutil.copy(FILES / name, folder)
        execute("systemctl", "daemon-reload")
        yield
    finally:
        shutil.rmtree(folder)
        execute("systemctl", "daemon-reload")


def can_be_plugged(chip: Chip) -> bool:
    try:
        chip.plug()
    except AssertionError:
        return False
    return True


def read_state(simulator: HostProcess) -> dict[str, Any]:
    file = HOST / "systemd.json"
    file.unlink(missing_ok=True)
    simulator.user_signal()
    wait_until(file.exists, "the simulator's state")
    return dict(json.loads(file.read_text()))


class TestUnit:
    def test_verify_is_silent(self) -> None:
        units = ("can-bridge@can232.service", "can-bridge-interface@can232.service")
        assert execute("systemd-analyze", "verify", *units) == ""

    def test_exposure(self) -> None:
        for unit, tenths in ((UNIT, 11), (UNIT.with_name("can-bridge-interface@.service"), 13)):
            execute("systemd-analyze", "security", "--offline=true", f"--threshold={tenths}", unit)

    def test_start_and_stop(self, rig: Rig, can232: Instance) -> None:
        status = can232.wait_status("running: ")
        assert status.startswith("running: CAN232 V1")
        assert status.endswith(f" on {NAMED}/RIG0001, {can232.interface}")
        process = Path("/proc", str(can232.pid))
        assert process.owner() == "can-bridge"
        status = (process / "status").read_text()
        for kind in ("Inh", "Prm", "Eff", "Bnd", "Amb"):
            assert f"Cap{kind}:\t0000000000000000\n" in status

        rig.cansend(can232.interface, "123#1122")
        answer = json.loads(execute("can-bridge", "status", "--json", "--socket", can232.socket))
        assert answer["state"] == "running"
        assert "running" in execute("can-bridge", "status", "can232")

        assert "state=running" in can232.log("BRIDGE=can232", "STATE=running", "PRIORITY=6")
        assert can232.systemctl("stop") < STOP_LIMIT_S
        assert can232.show("Result") == "success"
        assert not can232.socket.exists()

    def test_a_boot_does_not_hang_without_the_interface(self, instance: Callable[[str], Instance]) -> None:
        """It is ready without one, says so, and takes it when it comes."""
        made = instance("early")
        made.configure("/dev/ttyUSB99", create=False)
        assert made.systemctl("start") < 10.0  # 5 s, and a slow Python's start
        assert made.show("ActiveState") == "active"
        made.wait_status(f"bus not open: {made.interface}: there is no such interface")
        assert "ready without the CAN interface" in made.log("BRIDGE=early", "PRIORITY=3")
        execute("ip", "link", "add", "dev", made.interface, "type", "vcan")
        execute("ip", "link", "set", made.interface, "up")
        made.wait_status("waiting: ")

    def test_without_an_adapter(self) -> None:
        """The commands of systemd/README.md, the last of which shows five frames of a simulated adapter."""
        (text,) = re.findall(
            r"## Try the service without an adapter\n.*?```sh\n(.*?)```",
            (FILES / "README.md").read_text(),
            re.DOTALL,
        )
        try:
            said = execute("sh", "-euc", f"cd {FILES}; {text}")
            assert said.count(" vcan0 ") == 5, said
            assert "running" in execute("can-bridge", "status", "simulated")
        finally:
            execute("systemctl", "stop", "can-bridge@simulated", "simulated-adapter", status=None)
            execute("ip", "link", "delete", "vcan0", status=None)

    def test_an_interface_that_is_deleted_is_told(self, can232: Instance) -> None:
        """The bridge may not make it anew, but takes it when its unit has; with create.conf it may."""
        execute("ip", "link", "delete", can232.interface)
        advice = "`systemctl start can-bridge-interface@NAME` makes it now"
        wait_until(lambda: advice in can232.log("BRIDGE=can232", "PRIORITY=3"), "the log to tell what to do")
        assert f"bus lost: socketcan {can232.interface}" in can232.log("PRIORITY=3")
        execute("systemctl", "start", "can-bridge-interface@can232")
        can232.wait_status("running: CAN232")

        with drop_in(can232, "create.conf"):
            can232.systemctl("restart")
            can232.wait_status("running: ")
            execute("ip", "link", "delete", can232.interface)
            made_anew = Path(f"/sys/class/net/{can232.interface}")
            wait_until(made_anew.exists, "the interface to be made anew")
            can232.wait_status("running: ")
        can232.systemctl("restart")  # its unit finds it there

    def test_another_interface_after_a_reload_is_told(self, can232: Instance) -> None:
        can232.interface, before = "cbsother", can232.interface
        try:
            can232.configure(NAMED / "RIG0001")
            can232.systemctl("reload")
            wait_until(
                lambda: "cbsother: creating it needs CAP_NET_ADMIN: can-b" in can232.log(), "the log to tell"
            )
            can232.wait_status("bus not open: cbsother: creating it needs")
            can232.systemctl("restart")
            can232.wait_status("running: ")
        finally:
            execute("ip", "link", "delete", before)

    def test_restart(self, can232: Instance) -> None:
        pid = can232.pid
        can232.systemctl("restart")
        can232.wait_for_another(pid)
        assert can232.show("NRestarts") == "0"

    def test_reload(self, can232: Instance) -> None:
        pid, index = can232.pid, Path(f"/sys/class/net/{can232.interface}/ifindex").read_text()
        can232.configure(NAMED / "RIG0001", queue=77)
        can232.systemctl("reload")
        wait_until(lambda: "the adapter stays open" in can232.log(), "the new settings")
        assert can232.log().count("state=running") == 1
        can232.configure(NAMED / "RIG0001", queue=77, window=2)
        can232.systemctl("reload")
        wait_until(lambda: can232.log().count("state=running") == 2, "it to run again")
        wait_until(lambda: can232.show("ActiveState") == "active", "the end of the reload")
        can232.wait_status("running: ")
        assert can232.log().count("bus open") == 1  # and still is

        can232.file.write_text(can232.file.read_text().replace("queue: 77", "queue: many"))
        can232.systemctl("reload", status=None)
        assert "queue" in can232.wait_status("running: ").partition("reload refused: ")[2]
        assert f"{can232.file}:" in can232.log("PRIORITY=3")
        assert can232.show("ActiveState") == "active"
        assert (can232.pid, can232.show("NRestarts")) == (pid, "0")
        assert Path(f"/sys/class/net/{can232.interface}/ifindex").read_text() == index

    def test_killed(self, can232: Instance) -> None:
        """Started again by systemd, which has the interface made anew if somebody has deleted it."""
        pid = can232.pid
        execute("ip", "link", "delete", can232.interface)
        execute("systemctl", "kill", "-s", "KILL", can232.unit)
        can232.wait_for_another(pid)
        assert can232.show("NRestarts") == "1"

    def test_frozen(self, can232: Instance) -> None:
        """The watchdog sees to it."""
        pid = can232.pid
        time.sleep(1.5 * WATCHDOG_S)
        assert can232.pid == pid  # is fed as long as all is well
        execute("systemctl", "kill", "-s", "STOP", can232.unit)
        can232.wait_for_another(pid)
        assert "Watchdog timeout" in can232.log()

    def test_bad_configuration(self, instance: Callable[[str], Instance]) -> None:
        made = instance("bad")
        made.configure("/dev/ttyUSB0", window="wide")
        made.systemctl("start", status=1)
        assert (made.show("ExecMainStatus"), made.show("NRestarts")) == ("78", "0")
        assert made.show("ActiveState") == "failed"
        assert f"{made.file}:" in made.log()

    def test_instances_do_not_disturb_each_other(self, instance: Callable[[str], Instance]) -> None:
        one, two = instance("one"), instance("two")
        for made in (one, two):
            made.configure("/dev/can-bridge/none")
            made.systemctl("start")
        one.systemctl("stop")
        assert two.socket.is_socket()
        user = ("setpriv", "--reuid=nobody", "--regid=nogroup")
        asked = execute(*user, "--clear-groups", "can-bridge", "status", "two", status=3)
        assert asked == f"can-bridge: no permission for {two.socket}: " + (
            "usermod -aG can-bridge USER, then log in again; or ask as root (sudo)"
        )
        assert "two: " in execute(*user, "--groups=can-bridge", "can-bridge", "status", "two", status=3)

    def test_root_runs_another_by_hand(self, instance: Callable[[str], Instance]) -> None:
        """Beside the service's; never the same one, which would be two of a name."""
        one, two = instance("one"), instance("two")
        for made in (one, two):
            made.configure("/dev/can-bridge/none")
        two.systemctl("start")
        refused = execute("can-bridge", "run", "two", status=1)
        assert f"a bridge named 'two' is running already (it answers on {two.socket})" in refused
        socket_path = Path("/run/can-bridge/one.sock")
        process = subprocess.Popen(["can-bridge", "run", "one"])
        try:
            wait_until(socket_path.is_socket, "the status socket")
            found = socket_path.stat()
            assert (socket_path.owner(), socket_path.group(), found.st_mode & 0o777) == (
                "root",
                "can-bridge",
                0o660,
            )
            member = ("setpriv", "--reuid=nobody", "--regid=nogroup", "--groups=can-bridge")
            lines = execute(*member, "can-bridge", "status", status=3).splitlines()
            assert [line.partition(":")[0] for line in lines] == ["one", "two"]
        finally:
            process.terminate()
            assert process.wait(DEADLINE_S) == 0
        assert not socket_path.exists()

    def test_upgrade(self, can232: Instance, rig: Rig) -> None:
        """From the unit of the version before, which had the capability and one directory for all sockets.

        The new program runs with the old unit, so that the two need not change in one moment.
        """
        can232.systemctl("stop")
        UNIT.with_name("can-bridge-interface@.service").unlink()
        Path("/etc/sysctl.d/10-can-bridge.conf").unlink()
        before = FILES.parent / "tests/system/before"
        shutil.copy(before / "can-bridge@.service", UNIT)
        shutil.copy(before / "70-can-bridge.rules", "/etc/udev/rules.d")
        shutil.copy(before / "can-bridge.sysusers", "/etc/sysusers.d/can-bridge.conf")
        execute("systemctl", "daemon-reload")
        execute("udevadm", "control", "--reload")
        execute("udevadm", "trigger", "--settle", "--subsystem-match=tty")
        can232.systemctl("start")
        can232.wait_status("running: ")
        old_socket = Path("/run/can-bridge/can232.sock")
        assert old_socket.owner() == "can-bridge"
        dump = rig.candump(can232.interface)

        install(FILES)
        assert (NAMED / "RIG0001").is_char_device()
        assert "can232: running, " in execute("can-bridge", "status", "can232")  # at its old place
        can232.systemctl("restart")
        can232.wait_status("running: ")
        assert can232.socket.is_socket()
        assert not old_socket.exists()
        assert "can232: running, " in execute("can-bridge", "status", "can232")
        rig.cansend(can232.interface, "123#1122")
        assert dump.finish(1) == ["123#1122"]  # the interface is the same

    def test_raw_usb(self, rig: Rig, instance: Callable[[str], Instance]) -> None:
        chip = rig.chip("ftdi0")
        simulator = rig.host_simulate("--state", "systemd.json")
        made = instance("usb2can")
        made.configure(f"usb://0403:6001/{chip.serial_number}", adapter="usb2can")
        made.systemctl("start")
        made.wait_status("running: USB2CAN HW")
        made.systemctl("stop")
        assert read_state(simulator)["state"] == "config"

    def test_serial_server(self, instance: Callable[[str], Instance]) -> None:
        made = instance("server")
        with socket.create_server(("127.0.0.1", 0)) as server:
            server.settimeout(DEADLINE_S)
            made.configure(f"socket://127.0.0.1:{server.getsockname()[1]}")
            made.systemctl("start")
            made.wait_status("waiting: ")  # no internet
            with drop_in(made, "network.conf"):
                made.systemctl("restart")
                server.accept()[0].close()


class TestDevices:
    def test_names_and_latency(self, rig: Rig) -> None:
        for name in ("ftdi0", "ftdi1"):
            chip = rig.chip(name)
            tty = chip.wait_tty()
            link = NAMED / chip.serial_number
            wait_until(link.exists, "the name that stays")
            assert link.resolve() == tty
            assert (Path("/sys/class/tty") / tty.name / "device/latency_timer").read_text() == "1\n"
        asked = execute("udevadm", "info", "--query=property", "--property=ID_MM_PORT_IGNORE", "--value", tty)
        assert asked == "1"

    def test_a_second_device_of_a_serial_number_does_not_take_the_name(self, rig: Rig) -> None:
        first, second = rig.chip("ftdi0"), rig.chip("ftdi1")
        link, tty = NAMED / first.serial_number, first.wait_tty()
        wait_until(link.exists, "the name that stays")
        second.unplug()
        second.serial_number, own = first.serial_number, second.serial_number
        try:
            ask_monitor(
                "device_add",
                driver="usb-serial",
                id=second.name,
                chardev=second.name,
                serial=second.serial_number,
                **{"always-plugged": True},
            )
            wait_until(lambda: len(list(Path("/dev").glob("ttyUSB*"))) == 2, "the second terminal")
            execute("udevadm", "settle")
            assert link.resolve() == tty
            execute("udevadm", "trigger", "--settle", "--subsystem-match=tty")
            assert link.resolve() == tty
        finally:
            ask_monitor("device_del", id=second.name)
            wait_until(lambda: len(list(Path("/dev").glob("ttyUSB*"))) == 1, "the second one to be gone")
            second.serial_number = own
            wait_until(lambda: can_be_plugged(second), "QEMU to let go of the far end")
        assert link.resolve() == tty
        assert first.usb is not None
        bus, number = (int((first.usb / name).read_text()) for name in ("busnum", "devnum"))
        assert Path(f"/dev/bus/usb/{bus:03}/{number:03}").group() == "can-bridge"

    def test_power_up_without_adapter(self, rig: Rig, instance: Callable[[str], Instance]) -> None:
        """And without its driver: the device's kind must be allowed before it exists."""
        chips = [rig.chip(name) for name in ("ftdi0", "ftdi1")]
        made = instance("can232")
        made.configure(NAMED / chips[0].serial_number)
        with contextlib.ExitStack() as stack:
            for chip in chips:
                chip.unplug()
                stack.callback(chip.plug)
            execute("modprobe", "-r", "ftdi_sio", "usbserial")
            assert "ttyUSB" not in Path("/proc/devices").read_text()
            made.systemctl("start")
            assert made.show("ActiveState") == "active"
            made.wait_status(f"waiting: {NAMED}/RIG0001: does not exist")
        rig.host_simulate("--state", "systemd.json", adapter="can232")
        made.wait_status("running: ")

    def test_start_by_plugging_in(self, rig: Rig, instance: Callable[[str], Instance]) -> None:
        chip = rig.chip("ftdi0")
        rig.host_simulate("--state", "systemd.json", adapter="can232")
        made = instance("can232")
        made.configure(NAMED / chip.serial_number)
        example = next(
            line for line in (FILES / "README.md").read_text().splitlines() if "SYSTEMD_WANTS" in line
        )
        START_RULES.write_text(example.replace("A6008isP", chip.serial_number) + "\n")
        try:
            execute("udevadm", "control", "--reload")
            chip.unplug()
            assert made.show("ActiveState") == "inactive"
            chip.plug()
            made.wait_status("running: ")
        finally:
            START_RULES.unlink()
            execute("udevadm", "control", "--reload")

    def test_vcan_of_networkd(self) -> None:
        name, folder = "cbsnet", Path("/run/systemd/network")
        blocks = (FILES / "README.md").read_text().split("  # /etc/systemd/network/")[1:]
        texts = [block.split("```")[0].replace("vcan0", name).splitlines()[1:] for block in blocks]
        folder.mkdir(parents=True, exist_ok=True)
        for kind, lines in zip(("netdev", "network"), texts, strict=True):
            (folder / f"40-{name}.{kind}").write_text("\n".join(line.strip() for line in lines))
        execute("systemctl", "unmask", "systemd-networkd.service")
        try:
            execute("systemctl", "start", "systemd-networkd.service")
            flags = Path(f"/sys/class/net/{name}/flags")
            wait_until(lambda: flags.exists() and int(flags.read_text(), 16) & 1, "an interface that is up")
        finally:
            execute("systemctl", "mask", "--now", "systemd-networkd.service", status=None)
            execute("ip", "link", "delete", name, status=None)
