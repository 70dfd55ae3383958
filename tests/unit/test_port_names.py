"""What a port may be called, and what its name says."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from bridged.ports.names import SCHEMES, PortName


@pytest.mark.parametrize(
    ("text", "parts"),  # scheme, path, address, USB id, serial number
    [
        ("/dev/ttyUSB0", ("", "/dev/ttyUSB0", None, None, None)),
        ("socket://nas.local:4001", ("socket", "", ("nas.local", 4001), None, None)),
        ("rfc2217://[fe80::1%eth0]:65535/?x=1", ("rfc2217", "", ("fe80::1%eth0", 65535), None, None)),
        ("usb://0403:6001", ("usb", "", None, (0x0403, 0x6001), None)),
        ("usb://0403:6aB1/A6008isP", ("usb", "", None, (0x0403, 0x6AB1), "A6008isP")),
        ("usb-serial://A6008isP", ("usb-serial", "", None, None, "A6008isP")),
        ("usb-serial://a/b:c-01", ("usb-serial", "", None, None, "a/b:c-01")),
        ("usb-serial://", ("usb-serial", "", None, None, None)),
        ("usb-serial://two words", ("usb-serial", "", None, None, None)),
        ("socket://nas:0", ("socket", "", None, None, None)),
        ("socket://nas:65536", ("socket", "", None, None, None)),
        ("socket://-", ("socket", "", None, None, None)),
        ("usb://403:6001", ("usb", "", None, None, None)),
        ("usb://0403:6001/", ("usb", "", None, None, None)),
    ],
)  # fmt: skip
def test_parts(text: str, parts: tuple[object, ...]) -> None:
    name = PortName(text)
    assert (name.scheme, name.path, name.address, name.usb_id, name.serial_number) == parts


@given(st.text() | st.builds("{}://{}".format, st.sampled_from([*SCHEMES, "tcp"]), st.text()))
@example("socket:h:1")
@example("usb://0403:6001/A1")
def test_a_name_without_a_problem_says_what_to_open(text: str) -> None:
    name = PortName(text)
    if name.problem() is None:
        parts = (name.path, name.address, name.usb_id, name.is_tty_of_usb_device)
        assert [bool(part) for part in parts].count(True) == 1
        assert name.scheme in ("", *SCHEMES)


@pytest.mark.parametrize(
    ("text", "numbered"),
    [("/dev/pts/3", True), ("//dev/./pts/3", True), ("/dev/pts/ptmx", False), ("socket:///dev/pts/3", False)],
)
def test_a_terminal_that_the_kernel_numbers(text: str, numbered: bool) -> None:
    assert PortName(text).is_numbered_terminal is numbered
