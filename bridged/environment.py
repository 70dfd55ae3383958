"""Environment variables as a configuration, or laid over that of a file: `CAN_BRIDGE__SECTION__KEY`.

One rule for every key: `CAN_BRIDGE__CHANNEL__ACCEPTANCE__CODE` is `channel.acceptance.code`, and its value is
YAML as it would stand behind that key. The environment wins. (With one underscore, Kubernetes sets
CAN_BRIDGE_PORT and others by itself where a Service is called can-bridge. But a name with one in front and
two further on, as in CAN_BRIDGE_CHANNEL__LISTEN_ONLY, is a slip: passed over, it could let a bridge send that
must only listen.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from bridged.yaml_source import VARIABLE_PREFIX

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bridged.overlay import Setting
    from bridged.yaml_source import Problems

ORIGIN: Final = "the environment"
_SLIP: Final = VARIABLE_PREFIX.removesuffix("_")


def variables(environment: Mapping[str, str]) -> list[str]:
    """Their names, sections before what is in them."""
    names = (name for name in environment if name.startswith(VARIABLE_PREFIX) or _is_slip(name))
    return sorted(names, key=lambda name: (len(_path(name)), name))


def settings(environment: Mapping[str, str], problems: Problems) -> list[Setting]:
    """What the variables set; those that name no key are problems."""
    from bridged.overlay import Setting  # noqa: PLC0415 - a configuration in a file alone does without

    names = variables(environment)
    for name in filter(_is_slip, names):
        meant = VARIABLE_PREFIX + name.removeprefix(_SLIP)
        problems.add(0, 0, f"has one underscore too few; {meant} is probably meant", name)
    found = [Setting(name, _path(name), environment[name]) for name in names if not _is_slip(name)]
    for setting in found:
        if not all(setting.path):
            problems.add(0, 0, f"names no key; expected {VARIABLE_PREFIX}SECTION__KEY", setting.name)
    return [setting for setting in found if all(setting.path)]


def _is_slip(name: str) -> bool:
    return name.startswith(_SLIP) and not name.startswith(VARIABLE_PREFIX) and "__" in name


def _path(name: str) -> tuple[str, ...]:
    return tuple(name.removeprefix(VARIABLE_PREFIX).lower().split("__"))
