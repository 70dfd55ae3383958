"""Environment variables as a configuration, or laid over that of a file: `CAN_BRIDGE__SECTION__KEY`.

One rule for every key: `CAN_BRIDGE__CHANNEL__ACCEPTANCE__CODE` is `channel.acceptance.code`, and its value is
YAML as it would stand behind that key. The environment wins. (With one underscore, Kubernetes sets
CAN_BRIDGE_PORT and others by itself where a Service is called can-bridge.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from bridged.yaml_source import VARIABLE_PREFIX

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bridged.overlay import Setting
    from bridged.yaml_source import Problems

ORIGIN: Final = "the environment"


def variables(environment: Mapping[str, str]) -> list[str]:
    """Their names, sections before what is in them."""
    names = (name for name in environment if name.startswith(VARIABLE_PREFIX))
    return sorted(names, key=lambda name: (len(_path(name)), name))


def settings(environment: Mapping[str, str], problems: Problems) -> list[Setting]:
    """What the variables set; those that name no key are problems."""
    from bridged.overlay import Setting  # noqa: PLC0415 - a configuration in a file alone does without

    found = [Setting(name, _path(name), environment[name]) for name in variables(environment)]
    for setting in found:
        if not all(setting.path):
            problems.add(0, 0, f"names no key; expected {VARIABLE_PREFIX}SECTION__KEY", setting.name)
    return [setting for setting in found if all(setting.path)]


def _path(name: str) -> tuple[str, ...]:
    return tuple(name.removeprefix(VARIABLE_PREFIX).lower().split("__"))
