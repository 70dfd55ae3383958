"""What python-can's interfaces are called, which options each has, and which package one lacks here."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import inspect
import re
import sys
from typing import Any, Final

import can
from can.interfaces import BACKENDS

_OURS: Final = {"self", "channel", "can_filters", "receive_own_messages"}
"""Parameters of a bus that are no options in our file."""

_OPTION_IN_SOURCE: Final = re.compile(r"""kwargs(?:\.get\(|\.pop\(|\[)\s*["'](\w+)["']""")


def interface_problem(interface: str) -> str | None:
    """What is wrong with the name of an interface, or keeps it from being loaded; None if all is well."""
    if interface not in BACKENDS:
        import difflib  # noqa: PLC0415 - only for a file that is wrong

        near = difflib.get_close_matches(interface.lower(), BACKENDS, n=1)
        meant = f", {near[0]} is probably meant" if near else ""
        known = ", ".join(sorted(BACKENDS))
        return f"python-can {can.__version__} has no interface {interface!r}{meant}; it has {known}"
    if text := missing_package(interface):
        return text
    try:
        _bus_class(interface)
    except Exception as error:  # noqa: BLE001 - of Windows's libraries, for one: ImportError, AttributeError, OSError
        return f"{interface} cannot be loaded here: {error}{_extra_hint(interface)}"
    return None


def missing_package(interface: str) -> str | None:
    """How to get the package that an interface needs but imports too late to say so; None: it is there."""
    if interface == "udp_multicast" and importlib.util.find_spec("msgpack") is None:
        return f"{interface} needs the package msgpack: {_pip_install('msgpack')}"
    return None


def option_problem(interface: str, option: str) -> tuple[str, bool] | None:
    """What is wrong with the name of an option; True: the interface refuses it, False: it is ignored."""
    names, takes_any = _options(_bus_class(interface))
    if option in names:
        return None
    import difflib  # noqa: PLC0415 - as above

    near = difflib.get_close_matches(option.lower(), names, n=1)
    meant = f", {near[0]} is probably meant" if near else ""
    ignored = " and ignores it" if takes_any else ""
    text = f"python-can's {interface} has no such option{ignored}{meant}; it has {', '.join(sorted(names))}"
    return text, not takes_any


def _bus_class(interface: str) -> type[Any]:
    module, name = BACKENDS[interface]
    bus_class: type[Any] = getattr(importlib.import_module(module), name)
    return bus_class


def _options(bus_class: type[Any]) -> tuple[set[str], bool]:
    """The parameters of the constructors, each passes on what it does not know; whether anything is taken."""
    names: set[str] = set()
    takes_any = True
    for base in bus_class.__mro__[:-1]:
        constructor = vars(base).get("__init__")
        if constructor is None or not takes_any:
            continue
        parameters = inspect.signature(constructor).parameters.values()
        names.update(p.name for p in parameters if p.kind in {p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY})
        takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters)
        try:
            names.update(_OPTION_IN_SOURCE.findall(inspect.getsource(constructor)))
        except OSError:  # a driver without its source
            continue
    if "timing" in names:  # can.Bus makes it of these
        names.update(inspect.signature(can.BitTiming).parameters)
    return names - _OURS, takes_any


def _extra_hint(interface: str) -> str:
    """The command for what python-can calls an extra, as python-can[gs-usb]; nothing where there is none."""
    extra = interface.replace("_", "-")
    extras = importlib.metadata.metadata("python-can").get_all("Provides-Extra") or []
    return f": {_pip_install(f'python-can[{extra}]')}" if extra in extras else ""


def _pip_install(package: str) -> str:
    """The command that installs a package where this program looks for it."""
    return f"{sys.executable} -m pip install '{package}'"
