"""can-bridge check: what it warns of, which files it takes."""

import argparse
from pathlib import Path

import pytest

from bridged import cli
from bridged.config import check
from bridged.errors import ConfigError

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
        (
            "vcan0}",
            "vcan0}\nnotify: [/nowhere/tell, pc]",
            "4:1: notify: warning: there is no program '/nowhere",
        ),
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
        GOOD + "notify: [sh, -c, 'echo $CAN_BRIDGE_STATE']\n",
        GOOD.replace("can232", "usb2can") + "transmit: {window: 32}\n",
        GOOD.replace("vcan0", "virt, interface: virtual, rx_queue_size: 5, preserve_timestamps: yes"),
        GOOD.replace(
            "vcan0", "/dev/x, interface: slcan, tty_baudrate: 9600, brp: 1, tseg1: 1, tseg2: 1, sjw: 1"
        ),
    ],
)
def test_nothing_to_warn_of(tmp_path: Path, text: str) -> None:
    assert warnings_of(tmp_path, text) == []


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


@pytest.mark.parametrize("command", ["run", "interface"])
def test_no_configuration_at_all(etc: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    """As a container's first start: both ways to give one are named."""
    for file in etc.iterdir():
        file.unlink()
    assert cli.main([command]) == 78
    assert capsys.readouterr().err == (
        f"{etc}/can-bridge.yaml: there is no such file, "
        "and no environment variable CAN_BRIDGE__SECTION__KEY\n"
    )


def test_a_reload_does_not_go_on_without_the_file(etc: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though the variables would do alone: the bridge was listen-only by the file."""
    monkeypatch.setenv("CAN_BRIDGE__ADAPTER", "{type: can232, port: /dev/ttyUSB0}")
    monkeypatch.setenv("CAN_BRIDGE__CHANNEL__BITRATE", "125000")
    monkeypatch.setenv("CAN_BRIDGE__BUS__CHANNEL", "vcan0")
    file = etc / "mine.yaml"
    file.write_text("channel: {listen_only: true}\n")
    args = argparse.Namespace(config=str(file), settings=[])
    assert cli._given_anew(args, from_file=True).channel.listen_only
    file.unlink()
    with pytest.raises(ConfigError, match=r"mine\.yaml: there is no such file any more"):
        cli._given_anew(args, from_file=True)
    assert not cli._given_anew(args, from_file=False).channel.listen_only  # there never was one


@pytest.mark.parametrize(("uid", "name"), [(65534, "nobody"), (61234, "user 61234")])
def test_who_may_not_read_it(
    etc: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], uid: int, name: str
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("os.geteuid", lambda: uid)
    monkeypatch.setattr(Path, "open", refuse)
    assert cli.main(["check", "a"]) == 78
    assert capsys.readouterr().err == f"{etc}/a.yaml: cannot be read: Permission denied (as {name})\n"


def test_the_environment(
    etc: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over a file; alone, where there is none; and named where it is wrong."""
    monkeypatch.setenv("CAN_BRIDGE__CHANNEL__BITRATE", "500000")
    file = next(iter(sorted(etc.glob("*.yaml"))))
    assert cli.main(["check", str(file)]) == 0
    assert f"{file}, CAN_BRIDGE__CHANNEL__BITRATE: OK: " in (out := capsys.readouterr().out)
    assert "500000 bit/s" in out
    for path in etc.glob("*.yaml"):
        path.unlink()
    for name, value in {"ADAPTER": "{type: can232, port: /dev/ttyUSB0}", "BUS__CHANNEL": "vcan0"}.items():
        monkeypatch.setenv(f"CAN_BRIDGE__{name}", value)
    assert cli.main(["check"]) == 0
    names = "CAN_BRIDGE__ADAPTER, CAN_BRIDGE__BUS__CHANNEL, CAN_BRIDGE__CHANNEL__BITRATE"
    assert capsys.readouterr().out.startswith(f"{names}: OK: can232 on /dev/ttyUSB0")
    assert cli.main(["interface"]) == 0
    assert capsys.readouterr().out == f"vcan0: not made, since {names} does not say create: true\n"
    monkeypatch.setenv("CAN_BRIDGE__BUS__CREATE", "perhaps")
    assert cli.main(["check"]) == 78
    out, err = capsys.readouterr()
    assert (out, err.splitlines()[0]) == (
        "",
        f"{etc}/can-bridge.yaml: there is no such file: the environment is all there is",
    )
    assert "\nCAN_BRIDGE__BUS__CREATE: bus.create: expected true or false, got the text 'perhaps'\n" in err
