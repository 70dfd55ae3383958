"""The house: who may import whom, where an adapter's name may stand, and where a module's tests are.

Imports only needed for types count too: what a part knows, it knows also in its annotations.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import bridged
from bridged.adapters import TYPES
from bridged.simulators import SIMULATORS

HOUSE = Path(bridged.__file__).parent
# Values without a subject of their own: an error, a text fit for a terminal.
ANYWHERE = {"errors", "text"}
# Each part of the house and the parts that it may import; what is not listed here may not be imported.
ALLOWED: dict[str, set[str]] = {
    "__main__": {"cli"},
    "cli": {
        "adapters",
        "bridge",
        "capture",
        "config",
        "daemon",
        "demo",
        "environment",
        "interfaces",
        "listing",
        "options",
        "overlay",
        "ports",
        "settings",
        "simulators",
    },
    "capture": {"adapters", "ports", "settings"},
    "listing": {"adapters", "daemon", "ports"},
    "demo": {"bridge", "config", "daemon", "interfaces", "simulators"},
    "daemon": {"bridge", "config", "settings"},
    "bridge": {"adapters", "can", "interfaces", "ports", "settings", "_relay"},
    "config": {
        "adapters",
        "can",
        "environment",
        "interfaces",
        "overlay",
        "ports.names",
        "settings",
        "yaml_source",
    },
    "environment": {"overlay", "yaml_source"},
    "options": {"overlay"},
    "overlay": {"yaml_source"},
    "yaml_source": set(),
    "settings": {"can"},
    "adapters": {"can", "settings"},
    "ports": set(),
    "interfaces": {"ports.pump"},
    "simulators": set(),
    "can": set(),
    "errors": set(),
    "text": set(),
}


def modules() -> dict[str, ast.Module]:
    """The modules of the house by their dotted names below `bridged`."""
    found = {}
    for path in sorted(HOUSE.rglob("*.py")):
        parts = path.relative_to(HOUSE).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if name:
            found[name] = ast.parse(path.read_text())
    return found


MODULES = modules()


def imports(tree: ast.Module) -> set[str]:
    """The modules of the house that a module imports, wherever in it."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {
                alias.name.removeprefix("bridged.")
                for alias in node.names
                if alias.name.startswith("bridged.")
            }
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "bridged":
            base = node.module.removeprefix("bridged").removeprefix(".")
            for alias in node.names:
                whole = f"{base}.{alias.name}" if base else alias.name
                found.add(whole if whole in MODULES or whole == "_relay" else base)
    return found - {""}


def part(module: str) -> str:
    return module.partition(".")[0]


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_only_what_its_part_may_know(module: str) -> None:
    here = part(module)
    allowed = ALLOWED[here]
    for target in imports(MODULES[module]):
        assert part(target) in {here, *ANYWHERE, *allowed} or target in allowed, (
            f"bridged.{module} must not import bridged.{target}: see ALLOWED in this file"
        )


def test_no_circle() -> None:
    graph = {module: imports(tree) & MODULES.keys() for module, tree in MODULES.items()}
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " -> ".join((*path, module))
        if module not in done:
            for target in sorted(graph[module]):
                visit(target, (*path, module))
            done.add(module)

    for module in graph:
        visit(module, ())


# --- how much a class may hold ----------------------------------------------------------------

DOZEN = 12
# Classes that hold more, and why. An entry may shrink, and goes when its class has become small enough.
LARGE = {
    "adapters.usb2can.Usb2can": 14,  # what the commands of one family have told of the device
    "simulators.can232.Can232": 15,  # the registers of a device
    "simulators.usb2can_firmware.Firmware": 19,  # the same
    "simulators.slcan.Slcan": 21,  # the same
    "simulators.uart.Uart": 16,  # what is on the line in each direction, and counters for the benches
    "simulators.serve.Simulator": 37,  # to be split: the device's ends, the agenda of its faults, its traffic
}


def attributes(class_: ast.ClassDef) -> set[str]:
    """Those that __init__ assigns."""
    inits = [node for node in class_.body if isinstance(node, ast.FunctionDef) and node.name == "__init__"]
    return {
        node.attr
        for init in inits
        for node in ast.walk(init)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
        if isinstance(node.value, ast.Name) and node.value.id == "self"
    }


def test_a_class_holds_at_most_a_dozen_things() -> None:
    found = {
        f"{module}.{node.name}": len(attributes(node))
        for module, tree in MODULES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    }
    too_large = {name: n for name, n in found.items() if n > LARGE.get(name, DOZEN)}
    assert not too_large, "split the class into parts that own what they do"
    assert not {name for name in LARGE if found.get(name, 0) <= DOZEN}, "these are small enough now"


# --- where an adapter's name may stand ---------------------------------------------------------

NAMES = TYPES.keys() | SIMULATORS.keys()
NAMING = {"adapters", "simulators"}  # the registries are in there, too
CODECS = ("codec", "module_codecs")  # of the relay's files


def words(tree: ast.Module) -> set[str]:
    """All names, texts and docstrings of a module in lower case."""
    fields = (value for node in ast.walk(tree) for _, value in ast.iter_fields(node))
    flat = (one for value in fields for one in (value if isinstance(value, list) else [value]))
    return {word.lower() for word in flat if isinstance(word, str)}


@pytest.mark.parametrize("module", [name for name in MODULES if part(name) not in NAMING])
def test_no_adapter_is_named_outside_its_rooms(module: str) -> None:
    found = {name: word for name in NAMES for word in words(MODULES[module]) if name in word}
    assert not found, f"bridged.{module} is for all adapters alike: what one of them is belongs to its files"


@pytest.mark.parametrize("name", NAMES)
def test_the_relay_names_an_adapter_in_its_codec_only(name: str) -> None:
    for path in HOUSE.glob("relay/*.[ch]"):
        assert path.name.startswith(CODECS) or name not in path.read_text().lower(), path


# --- where the tests are ----------------------------------------------------------------------

TREES = {path.stem: ast.parse(path.read_text()) for path in sorted(Path(__file__).parent.glob("test_*.py"))}
FEW = 20  # statements in a module's functions: with fewer, as values and contracts have, others test it


def places_of(module: str) -> list[str]:
    """What the test files of a module may begin with: its name, and where that is not enough its room before.

    daemon.status: test_status or test_daemon_status; adapters.can232: test_adapter_can232 (there is a
    simulators.can232); bridge.interface: test_bridge_interface (there are interfaces). A module that is a
    part of another, as usb2can_firmware of usb2can, is tested with that.
    """
    room, _, stem = module.rpartition(".")
    beginnings = (stem[:at] for at, letter in enumerate(stem) if letter == "_")
    stem = next((whole for whole in beginnings if f"{room}.{whole}" in MODULES), stem)
    rooms = {part(name).removesuffix("s") for name in MODULES if "." in name}
    alone = [name.rpartition(".")[2] for name in MODULES].count(stem) == 1 and stem not in rooms
    plain = [f"test_{stem}"] if alone or room in ("", stem) else []
    return plain + ([f"test_{room.removesuffix('s')}_{stem}"] if room else [])


def statements(tree: ast.Module) -> int:
    """How many statements the functions of a module have that are more than a name and a docstring."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    bodies = [node.body for node in functions if any(not isinstance(s, ast.Expr) for s in node.body)]
    return sum(isinstance(node, ast.stmt) for body in bodies for s in body for node in ast.walk(s))


@pytest.mark.parametrize("module", [name for name, tree in MODULES.items() if statements(tree) >= FEW])
def test_a_module_has_its_tests_where_one_looks_for_them(module: str) -> None:
    places = places_of(module)
    found = [file for file in TREES if any(file == name or file.startswith(f"{name}_") for name in places)]
    assert found, f"bridged.{module} has no tests/unit/{' or '.join(f'{name}*.py' for name in places)}"


@pytest.mark.parametrize("file", TREES)
def test_no_test_module_is_a_library(file: str) -> None:
    """What several test modules share is in tests/unit/benches and tests/books.py."""
    for node in ast.walk(TREES[file]):
        imported = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        imported += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        assert not {name.partition(".")[0] for name in imported} & TREES.keys()
