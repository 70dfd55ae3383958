"""bridged.overlay: what is given one by one, over what is there."""

from __future__ import annotations

from bridged.config import load_options
from bridged.overlay import Setting


def test_options_win_over_the_environment() -> None:
    """And what they do not say stays."""
    environment = {
        "CAN_BRIDGE__ADAPTER": "{type: can232, port: /dev/ttyUSB0}",
        "CAN_BRIDGE__CHANNEL__BITRATE": "125000",
        "CAN_BRIDGE__BUS__CHANNEL": "vcan0",
    }
    options = [
        Setting("--bitrate", ("channel", "bitrate"), "250000"),
        Setting("--port", ("adapter", "port"), "/dev/ttyUSB1"),
    ]
    config = load_options(options, environment)
    assert (config.adapter.type, config.adapter.port) == ("can232", "/dev/ttyUSB1")
    assert config.channel.timing.bitrate == 250_000
    assert config.name == "vcan0"


def test_sections_go_before_what_is_in_them() -> None:
    options = [
        Setting("--bitrate", ("channel", "bitrate"), "250000"),
        Setting("--channel", ("channel",), "{bitrate: 125000, listen_only: true}"),
        Setting("--adapter", ("adapter",), "{type: can232, port: /dev/ttyUSB0}"),
        Setting("INTERFACE", ("bus", "channel"), "239.1.2.3"),
        Setting("--interface", ("bus", "interface"), "udp_multicast"),
    ]
    config = load_options(options)
    assert config.channel.timing.bitrate == 250_000
    assert config.channel.listen_only
    assert config.name == "239.1.2.3"


def test_a_name_is_no_path() -> None:
    """The status socket is called so."""
    options = [
        Setting("--adapter", ("adapter",), "{type: can232, port: /dev/ttyUSB0}"),
        Setting("--bitrate", ("channel", "bitrate"), "250000"),
        Setting("--bus", ("bus",), "{interface: slcan, channel: /dev/ttyS1}"),
    ]
    assert load_options(options).name == "-dev-ttyS1"
