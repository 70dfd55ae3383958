"""What is said about a device node that may not be opened."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from bridged.ports import permission
from bridged.ports.permission import explain_forbidden, explain_missing_group, explain_refused

NULL = Path("/dev/null")  # c 1:3
OTHER_GROUP = 12_345


@pytest.fixture(autouse=True)
def on_a_host(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Wherever the tests run."""
    monkeypatch.setattr(permission, "_CONTAINER_MARKS", (tmp_path / ".containerenv", tmp_path / ".dockerenv"))
    for name in ("KUBERNETES_SERVICE_HOST", "container", "NOTIFY_SOCKET"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(params=[".containerenv", ".dockerenv", "container", "KUBERNETES_SERVICE_HOST"])
def container(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Podman may hand systemd's socket in."""
    monkeypatch.setenv("NOTIFY_SOCKET", "/run/notify")
    if request.param.startswith("."):
        (tmp_path / request.param).touch()
    else:
        monkeypatch.setenv(request.param, "10.0.0.1")


def status(gid: int, mode: int = 0o660) -> os.stat_result:
    return os.stat_result((stat.S_IFCHR | mode, 0, 0, 1, 0, gid, 0, 0, 0, 0))


def test_a_group_that_may_use_it(monkeypatch: pytest.MonkeyPatch) -> None:
    text = f"has no permission: add it to group {OTHER_GROUP} (`usermod -aG {OTHER_GROUP} "
    assert text in explain_missing_group(status(OTHER_GROUP))
    assert explain_missing_group(status(os.getegid())) == ""
    assert explain_missing_group(status(OTHER_GROUP, 0o640)) == ""
    monkeypatch.setattr(os, "getegid", lambda: OTHER_GROUP)
    monkeypatch.setattr(os, "getgroups", list)
    assert explain_missing_group(status(0)) == ""


@pytest.mark.usefixtures("container")
def test_a_group_that_a_container_has_not() -> None:
    text = explain_missing_group(status(OTHER_GROUP))
    for part in (
        f"--group-add {OTHER_GROUP} ",
        f'group_add: ["{OTHER_GROUP}"]',
        f"supplementalGroups: [{OTHER_GROUP}]",
    ):
        assert part in text
    assert "usermod" not in text
    assert "--group-add keep-groups" in explain_missing_group(status(65_534))


def test_what_is_not_in_the_device_cgroup(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (
        explain_forbidden(NULL)
        == "/dev/null is none of the devices that this program may use: run the container with "
        '--device-cgroup-rule="c 1:* rmw" (compose: device_cgroup_rules: ["c 1:* rmw"]; Kubernetes has no '
        "such rules: it takes a device plugin)"
    )
    monkeypatch.setenv("NOTIFY_SOCKET", "/run/notify")
    assert explain_forbidden(NULL).endswith(": add DeviceAllow=char-mem rw to the service")
    monkeypatch.setattr(permission, "_PROC", tmp_path)
    (tmp_path / "devices").write_text("Character devices:\n 10 misc\n\nBlock devices:\n  1 ramdisk\n")
    assert explain_forbidden(NULL).endswith(": add DeviceAllow=char-1 rw to the service")
    assert explain_forbidden(tmp_path / "unplugged") == f"{tmp_path}/unplugged may not be opened"


@pytest.mark.usefixtures("container")
def test_the_rule_for_a_container() -> None:
    assert '--device-cgroup-rule="c 1:* rmw"' in explain_forbidden(NULL)


def test_no_device_at_all(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert explain_refused(tmp_path / "file") == "not a serial port"
    assert explain_refused(tmp_path / "missing") == "no permission to look into its folder"
