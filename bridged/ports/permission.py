"""Why a device node may not be opened, and what to do about it: on a host, in a service, in a container."""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import stat
from pathlib import Path
from typing import Final

_PROC: Final = Path("/proc")
# Podman's file is not in each of its containers: with a read-only root it was missing.
_CONTAINER_VARIABLES: Final = frozenset({"container", "KUBERNETES_SERVICE_HOST"})
_CONTAINER_MARKS: Final = (Path("/run/.containerenv"), Path("/.dockerenv"))  # of podman, of docker

_RULES: Final = "/etc/udev/rules.d/70-can-bridge.rules"
_GROUP: Final = "can-bridge"  # of systemd/can-bridge.sysusers, which the udev rules name
_NO_SUCH_GROUP: Final = 65_534  # how a group is shown that the user namespace has not


def user_name() -> str:
    """Of this process."""
    uid = os.geteuid()
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def explain_refused(node: Path) -> str:
    """EACCES: its mode, owner and group do not let this process in."""
    try:
        status = node.stat()
    except OSError:
        return "no permission to look into its folder"
    if not stat.S_ISCHR(status.st_mode):
        return "not a serial port"
    if missing := explain_missing_group(status):
        return missing
    owner = f"{stat.filemode(status.st_mode)}, group {_group_name(status.st_gid)}"
    service = ", and DeviceAllow= of the service" if _in_service() else ", or be root"
    advice = f"check the udev rule that gives it to a group{service}"
    return f"user {user_name()} has no permission ({owner}): {advice}"


def explain_refused_usb(node: Path, vendor: int, product: int) -> str:
    """EACCES for the node of a USB device itself, not of its tty."""
    with contextlib.suppress(OSError):  # just unplugged
        if missing := explain_missing_group(node.stat()):
            return f"{node}: {missing}"
    user = user_name()
    attributes = f'ATTR{{idVendor}}=="{vendor:04x}", ATTR{{idProduct}}=="{product:04x}"'
    try:
        group = grp.getgrnam(_GROUP).gr_name
    except KeyError:
        group = "plugdev"
    rule = f'SUBSYSTEM=="usb", {attributes}, MODE="0660", GROUP="{group}"'
    return (
        f"user {user} has no permission for {node}: put the line {rule} into {_RULES}, run "
        "`udevadm control --reload && udevadm trigger --subsystem-match=usb`, "
        f"and see to it that {user} is in group {group}"
    )


def explain_missing_group(status: os.stat_result) -> str:
    """What is to be done if the node's group may use it, and this process is not in that; else "".

    Nobody is told to join the group root, which the kernel gives to the nodes of USB devices.
    """
    gid = status.st_gid
    if gid == 0 or status.st_mode & 0o060 != 0o060 or gid in {os.getegid(), *os.getgroups()}:
        return ""
    user, group = user_name(), _group_name(gid)
    if not in_container():
        return f"user {user} has no permission: add it to group {group} (`usermod -aG {group} {user}`)"
    if gid == _NO_SUCH_GROUP:
        return (
            "its group is not known in this container: let the user who runs the container be in that group, "
            "and run it with --group-add keep-groups (podman)"
        )
    return (
        f"user {user} has no permission: run the container with --group-add {gid} "
        f'(compose: group_add: ["{gid}"]; Kubernetes: supplementalGroups: [{gid}])'
    )


def explain_forbidden(node: Path) -> str:
    """EPERM: the device cgroup, which is a list of devices, does not have it."""
    try:
        major = os.major(node.stat().st_rdev)
    except OSError:
        return f"{node} may not be opened"
    if _in_service():
        advice = f"add DeviceAllow=char-{_driver(major)} rw to the service"
    else:
        rule = f"c {major}:* rmw"
        advice = (
            f'run the container with --device-cgroup-rule="{rule}" (compose: '
            f'device_cgroup_rules: ["{rule}"]; Kubernetes has no such rules: it takes a device plugin)'
        )
    return f"{node} is none of the devices that this program may use: {advice}"


def _group_name(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def _driver(major: int) -> str:
    """`ttyUSB` for 188, as /proc/devices has it; the number where it has it not."""
    characters = (_PROC / "devices").read_text().partition("Block devices:")[0]
    for line in characters.splitlines():
        number, _, name = line.strip().partition(" ")
        if number == str(major):
            return name
    return str(major)


def in_container() -> bool:
    named = not _CONTAINER_VARIABLES.isdisjoint(os.environ)
    return named or any(mark.exists() for mark in _CONTAINER_MARKS)


def _in_service() -> bool:
    """Whether systemd has started this program itself, and no container."""
    return "NOTIFY_SOCKET" in os.environ and not in_container()
