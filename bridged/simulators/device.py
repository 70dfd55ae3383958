"""The contract of a simulator: what its module has (`SimulatorModule`), and what its device does (`Device`).

To add one: a file in this directory with all of `SimulatorModule`, and a line in SIMULATORS (__init__.py).
`can-bridge simulate`, `can-bridge demo` and the tests that run over all simulators (tests/unit/
test_simulator_contract.py, test_adapter_contract.py) take it from there. can232.py is an example. A clone
may subclass the device of another file, and take that file's options and faults as they are.

Rules:
- A device does no I/O and has no clock of its own: each method is told the time, in seconds of a clock that
  never goes back. What is due in between happens in `advance`, each thing at its own time.
- Randomness, if any, comes from a `random.Random` with a seed.
- Nothing comes from adapters/ or the codecs: the simulator is the independent reading of the manual. What
  that leaves open is decided in the file's docstring, in words.
- No frame disappears uncounted: `counters` says what became of each.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

if TYPE_CHECKING:
    import argparse
    import enum
    from collections.abc import Callable, Mapping

    from bridged.simulators.sja1000 import Frame


class OwnFault(NamedTuple):
    """A fault of this kind of device, besides those of faults.py; it has one of the two actions."""

    meaning: str
    """For `can-bridge simulate ADAPTER --help`."""

    switch: Callable[[Any, float, int], None] | None = None
    """Called with the device, the time and how often it shall happen: 1; sys.maxsize: as long as the fault
    lasts; 0: the fault is over."""

    burst: Callable[[Any, float], None] | None = None
    """Called with the device and the time: once, or every BURST_S as long as the fault lasts."""


class SimulatorModule(Protocol):
    """What the module of a simulator has at its top level."""

    TITLE: str
    """Maker and product, for the list in `can-bridge simulate --help`."""

    ADAPTER: Mapping[str, str | int]
    """The keys of `adapter` in a bridge's configuration that go with this device, without `port`, and without
    `baudrate`, which who sets `--uart-rate` knows. Empty: no type of adapter drives it yet."""

    FAULTS: Mapping[str, OwnFault]
    """By name, letters and at most one digit at the end; also the `own_faults` of the device."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Adds the options that only this simulator has; options.py has checks for their values.

        One with a serial line has `--uart-rate BAUD`, default None: as fast as it goes. Some have a meaning
        for all simulators: `--eeprom FILE` (keeps `device.eeprom`), `--precise` (spins for exact timing).
        """

    def make_device(self, now: float, args: argparse.Namespace) -> Device:
        """The device, switched on at `now`: `args` has what add_arguments() adds, and `processing`, the time
        in seconds that it takes for a command. PortError if a file that an option names cannot be used.
        """


class DeviceCounters(Protocol):
    """Those that every device has."""

    frames_taken: int  # from the host into the transmit buffer: sent, discarded, or still in there
    frames_sent: int  # put on the bus
    frames_discarded: int  # taken, and never put on the bus
    frames_received: int  # from the bus, for the host
    frames_lost: int  # from the bus, no room
    frames_filtered: int  # from the bus, not accepted
    frames_unseen: int  # on the bus while the channel was closed


class Device(Protocol):
    """What a Simulator (serve.py) asks of a device, see Can232.

    One with an attribute `uart` (a Uart) is asked for the pace of its serial line: without it a host that
    does not read holds the device back, as USB does. One with an `eeprom`, a dataclass with a field `writes`,
    has it kept in a file.
    """

    own_faults: Mapping[str, OwnFault]

    # Faults that last, set and cleared by faults.py
    silent: bool  # carries out commands, sends nothing
    refusals: int  # so many frames from the host are refused
    drop_answers: int  # so many answers are lost on their way

    @property
    def title(self) -> str:
        """What it is called, with what tells it from another of its kind: `CAN232 A123`."""

    @property
    def state(self) -> enum.Enum:
        """Of the CAN channel; the values are shown as they are."""

    @property
    def counters(self) -> DeviceCounters: ...

    # What befalls it

    def power_on(self, now: float) -> None:
        """Power is back: it starts at once, with what its EEPROM has."""

    def power_off(self, now: float) -> None:
        """Nothing goes in or out until power_on()."""

    def power_cycle(self, now: float) -> None:
        """Off and on again at once."""

    def set_bus_off(self, now: float, bus_off: bool) -> None:
        """No frame leaves or comes as long as it lasts."""

    def set_listen_only(self, now: float, listen_only: bool) -> None:
        """Listen-only mode that its host did not ask for."""

    def set_error_counters(self, now: float, tec: int, rec: int) -> None:
        """Errors on its bus have brought the counters to these values."""

    def garbage(self, now: float, noise: bytes) -> None:
        """Noise on the line to the host."""

    # Its two sides

    def host_writes(self, now: float, data: bytes) -> None:
        """Bytes from the host, cut anywhere."""

    def take_output(self, now: float) -> bytes:
        """What has reached the host by `now`."""

    def bus_frame(self, now: float, frame: Frame) -> None:
        """Another node's frame was on the bus at `now`."""

    def take_bus_frames(self) -> list[Frame]:
        """What the device has put on the bus up to the last advance()."""

    def advance(self, now: float) -> None:
        """Live through all that is due by `now`."""

    def next_deadline(self) -> float:
        """When there is something new to see on either side if nothing else happens; math.inf: never."""

    def report(self) -> dict[str, object]:
        """State, settings and counters, fit for JSON: the state file of `--state`."""
