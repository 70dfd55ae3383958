"""The house: who may import whom, and where an adapter's name may stand.

Imports only needed for types count too: what a part knows, it knows also in its annotations.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import bridged

HOUSE = Path(bridged.__file__).parent
# Values without a subject of their own: an error, a text fit for a terminal.
ANYWHERE = {"errors", "text"}
# Each part of the house and the parts that it may import; what is not listed here may not be imported.
ALLOWED: dict[str, set[str]] = {
    "__main__": {"cli"},
    "cli": {
        "adapters",
        "bridge",
        "config",
        "daemon",
        "demo",
        "interfaces",
        "ports",
        "settings",
        "simulators",
    },
    "demo": {"bridge", "config", "daemon", "interfaces", "simulators"},
    "daemon": {"bridge", "config", "settings"},
    "bridge": {"adapters", "can", "interfaces", "ports", "settings", "_relay"},
    "config": {"adapters", "can", "interfaces", "ports.names", "settings", "yaml_source"},
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
