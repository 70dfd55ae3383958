"""What is known of python-can's interfaces before one is opened: names, packages, options."""

import sys
from pathlib import Path

import pytest

from bridged.config import check
from bridged.errors import ConfigError, InterfaceError
from bridged.interfaces import backends, open_interface

GOOD = "adapter: {type: can232, port: /dev/ttyUSB0}\nchannel: {bitrate: 125000}\nbus: {channel: vcan0}\n"


def warnings_of(tmp_path: Path, text: str) -> list[str]:
    path = tmp_path / "a.yaml"
    path.write_text(text)
    return [line.removeprefix(f"{path}:") for line in check(path)[1]]


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
    with pytest.raises(InterfaceError, match=text):
        open_interface("udp_multicast", "239.74.163.2", create=False, options={})
