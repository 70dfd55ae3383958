"""can-bridge check: what it warns of, what it knows of python-can, which files it takes."""

import sys
from pathlib import Path

import pytest

from bridged import cli
from bridged.config import check
from bridged.errors import BusError, ConfigError
from bridged.interfaces import backends, open_bus

GOOD = "adapter: {type: can232, port: /dev/ttyUSB0}\nchannel: {bitrate: 125000}\nbus: {channel: vcan0}\n"


def warnings_of(tmp_path: Path, text: str) -> list[str]:
    path = tmp_path / "a.yaml"
    path.write_text(text)
    return [line.removeprefix(f"{path}:") for line in check(path)[1]]


@pytest.mark.parametrize(
    ("old", "new", "warning"),
    [
        ("/dev/ttyUSB0", "/dev/pts/3", "1:25: adapter.port: warning: the next terminal gets this name"),
        ("/dev/ttyUSB0", "/dev/pts/../pts/3", "1:25: adapter.port: warning: the next terminal gets this"),
        (
            "vcan0}",
            "vcan0}\ntransmit: {deadline: 500}",
            "4:12: transmit.deadline: warning: a frame may reach",
        ),
        ("vcan0}", "vcan0}\ntransmit: {window: 5}", "4:12: transmit.window: warning: a CAN232 can hold 2"),
        ("vcan0}", "can0, create: true}", "3:7: bus.channel: warning: a virtual interface of this name"),
    ],
)
def test_what_is_probably_not_meant(tmp_path: Path, old: str, new: str, warning: str) -> None:
    (found,) = warnings_of(tmp_path, GOOD.replace(old, new))
    assert found.startswith(warning)


@pytest.mark.parametrize(
    "text",
    [
        GOOD,
        GOOD.replace("/dev/ttyUSB0", "/tmp/can232"),
        GOOD + "transmit: {window: 2, deadline: 10}\n",
        GOOD.replace("can232", "usb2can") + "transmit: {window: 32}\n",
        GOOD.replace("vcan0", "virt, interface: virtual, rx_queue_size: 5, preserve_timestamps: yes"),
        GOOD.replace(
            "vcan0", "/dev/x, interface: slcan, tty_baudrate: 9600, brp: 1, tseg1: 1, tseg2: 1, sjw: 1"
        ),
    ],
)
def test_nothing_to_warn_of(tmp_path: Path, text: str) -> None:
    assert warnings_of(tmp_path, text) == []


def test_an_option_that_python_can_ignores(tmp_path: Path) -> None:
    text = GOOD.replace("vcan0", "239.74.163.2, interface: udp_multicast, port: 1, hop_limti: 1")
    (found,) = warnings_of(tmp_path, text)
    assert found.startswith(
        "3:65: bus.hop_limti: warning: python-can's udp_multicast has no such option and ignores it, "
        "hop_limit is probably meant; it has fd, hop_limit, port"
    )


def test_an_option_that_a_driver_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Strict:
        def __init__(self, channel: str, *, speed: int = 1, receive_own_messages: bool = False) -> None: ...

    monkeypatch.setitem(backends.BACKENDS, "strict", (__name__, "Strict"))
    monkeypatch.setattr(sys.modules[__name__], "Strict", Strict, raising=False)
    with pytest.raises(
        ConfigError, match=r":3:38: bus.sped: python-can's strict has no such option, speed is"
    ):
        warnings_of(tmp_path, GOOD.replace("vcan0", "x, interface: strict, sped: 1"))


@pytest.mark.parametrize(
    ("interface", "text"),
    [
        (
            "udp_mutlicast",
            r"has no interface 'udp_mutlicast', udp_multicast is probably meant; it has canaly",
        ),
        ("nothing_like_it", r"has no interface 'nothing_like_it'; it has canalystii, "),
        (
            "gs_usb",
            rf"cannot be loaded here: No module .*: {sys.executable} -m pip install 'python-can.gs-usb.'",
        ),
    ],
)
def test_interfaces_that_cannot_be_used(tmp_path: Path, interface: str, text: str) -> None:
    with pytest.raises(ConfigError, match=rf"a\.yaml:3:30: bus\.interface: .*{text}"):
        warnings_of(tmp_path, GOOD.replace("vcan0", f"x, interface: {interface}"))


def test_a_package_that_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """check tells it, and so does the bridge, with the command for this environment."""
    monkeypatch.setattr(backends.importlib.util, "find_spec", lambda _: None)
    text = rf"udp_multicast needs the package msgpack: {sys.executable} -m pip install 'msgpack'"
    with pytest.raises(ConfigError, match=text):
        warnings_of(tmp_path, GOOD.replace("vcan0", "239.74.163.2, interface: udp_multicast"))
    with pytest.raises(BusError, match=text):
        open_bus("udp_multicast", "239.74.163.2", create=False, options={})


# --- The command --------------------------------------------------------------------------------------------


@pytest.fixture
def etc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """/etc/can-bridge with two good files, one of them with a warning."""
    monkeypatch.setattr(cli, "CONFIG_DIRECTORY", tmp_path)
    (tmp_path / "a.yaml").write_text(GOOD)
    (tmp_path / "b.yaml").write_text(GOOD + "transmit: {deadline: 500}\n")
    return tmp_path


def test_all_files(etc: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check"]) == 0
    out, err = capsys.readouterr()
    lines = [line for line in out.splitlines() if not line.startswith("  ")]  # without notes
    assert [line.split(": ")[:2] for line in lines] == [
        [f"{etc}/a.yaml", "OK"],
        [f"{etc}/b.yaml", "OK"],
    ]
    assert err.startswith(f"{etc}/b.yaml:4:12: transmit.deadline: warning:")

    (etc / "a.yaml").write_text("x")
    assert cli.main(["check"]) == 78
    out, err = capsys.readouterr()
    assert out.startswith(f"{etc}/b.yaml: OK")
    assert f"{etc}/a.yaml:1:1: " in err


def test_no_files(etc: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in etc.iterdir():
        file.unlink()
    assert cli.main(["check"]) == 78
    assert capsys.readouterr().err.startswith(f"{etc}: there is no configuration")


def test_standard_input(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Path] = []
    monkeypatch.setattr(cli, "_check_one", seen.append)
    assert cli.main(["check", "-"]) == 0
    assert seen == [Path("/dev/stdin")]
    assert not capfd.readouterr().err


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("a.yml", "a.yaml"),
        ("{etc}/a", "{etc}/a.yaml"),
        ("{etc}/a.yml", "{etc}/a.yaml"),
        ("elsewhere/a.yaml", "{etc}/a.yaml"),
        ("c", "a, b"),
    ],
)
@pytest.mark.parametrize("command", ["run", "check"])
def test_the_file_that_is_meant(
    etc: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    name: str,
    there: str,
) -> None:
    monkeypatch.chdir(etc)
    assert cli.main([command, name.format(etc=etc)]) == 78
    message = capsys.readouterr().err
    assert message.endswith(f": there is no such file; there is {there.format(etc=etc)}\n")


def test_who_may_not_read_it(
    etc: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("os.geteuid", lambda: 65534)
    monkeypatch.setattr(Path, "open", refuse)
    assert cli.main(["check", "a"]) == 78
    assert capsys.readouterr().err == f"{etc}/a.yaml: cannot be read: Permission denied (by user nobody)\n"
