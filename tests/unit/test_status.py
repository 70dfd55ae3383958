"""The status: who may ask, what others can do to its socket and a false one to who asks, how it is shown."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from benches.status_socket import listening, serving, snapshot

from bridged.daemon import directories, status, status_text
from bridged.daemon.status import NoAnswerError, StatusError, StatusServer, own_socket_path, query
from bridged.daemon.status_text import farewell, render

GROUP = 12345


def answer(text: bytes) -> Callable[[socket.socket], None]:
    return lambda connection: connection.sendall(text)


class TestServer:
    def test_who_asks_is_answered(self, tmp_path: Path) -> None:
        path = tmp_path / "a.sock"
        with serving(path, {"counters": {}, "name": "a"}):
            assert query(path)["name"] == "a"
            with pytest.raises(StatusError, match="running already"):
                StatusServer(path, dict)
            assert query(path)["name"] == "a"
        assert list(tmp_path.iterdir()) == []

    def test_one_that_a_dead_bridge_left_is_replaced(self, tmp_path: Path) -> None:
        path = tmp_path / "a.sock"
        with socket.socket(socket.AF_UNIX) as dead:
            dead.bind(str(path))
        StatusServer(path, dict).close()
        path.write_text("mine")
        with pytest.raises(StatusError, match="is no socket"):
            StatusServer(path, dict)
        assert path.read_text() == "mine"

    @pytest.mark.parametrize(("first", "second"), [("a.sock", "a/a.sock"), ("a/a.sock", "a.sock")])
    def test_the_service_and_one_by_hand_are_two_of_a_name(
        self, tmp_path: Path, first: str, second: str
    ) -> None:
        with serving(tmp_path / first, {"counters": {}}):
            with pytest.raises(
                StatusError, match=f"'a' is running already .it answers on {tmp_path}/{first}"
            ):
                StatusServer(tmp_path / second, dict)
            StatusServer(tmp_path / "b.sock", dict).close()
        with socket.socket(socket.AF_UNIX) as dead:
            dead.bind(str(tmp_path / first))
        StatusServer(tmp_path / second, dict).close()

    def test_a_sandbox_that_knows_no_group_is_not_asked(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def refused(_group: int) -> None:
            raise PermissionError

        monkeypatch.setattr(os, "setegid", refused)
        StatusServer(tmp_path / "a.sock", dict).close()

    def test_for_owner_and_group_whatever_the_umask(self, tmp_path: Path) -> None:
        before = os.umask(0)
        try:
            server = StatusServer(tmp_path / "a.sock", dict)
            assert os.umask(0) == 0
        finally:
            os.umask(before)
        assert (tmp_path / "a.sock").stat().st_mode & 0o777 == 0o660
        server.close()

    @pytest.mark.skipif(os.geteuid() != 0, reason="only root may choose a group")
    def test_roots_is_for_the_group_of_the_service(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        entry = status.grp.struct_group((status.GROUP, "x", GROUP, []))
        monkeypatch.setattr(status.grp, "getgrnam", lambda _name: entry)
        before = os.getegid()
        server = StatusServer(tmp_path / "a.sock", dict)
        assert ((tmp_path / "a.sock").stat().st_gid, os.getegid()) == (GROUP, before)
        server.close()

    def test_a_link_put_in_its_place_is_not_followed(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Who owns the directory can exchange the socket once it is there; here that always succeeds."""
        secret = tmp_path / "secret"
        secret.write_text("secret")
        secret.chmod(0o600)
        before = secret.stat()
        entry = status.grp.struct_group((status.GROUP, "x", GROUP, []))
        monkeypatch.setattr(status.grp, "getgrnam", lambda _name: entry)

        class Exchanged(socket.socket):
            def bind(self, address: Any) -> None:
                super().bind(address)
                Path(address).unlink()
                Path(address).symlink_to(secret)

        monkeypatch.setattr(status.socket, "socket", Exchanged)
        server = StatusServer(tmp_path / "a.sock", dict)
        server.close()
        after = secret.stat()
        assert (after.st_mode, after.st_uid, after.st_gid) == (before.st_mode, before.st_uid, before.st_gid)
        assert secret.read_text() == "secret"


class TestDirectory:
    @pytest.fixture
    def fallback(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """The directory of a user without XDG_RUNTIME_DIR."""
        monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
        monkeypatch.setattr(directories, "FALLBACK_RUNTIME", f"{tmp_path}/can-bridge-{{uid}}")
        uid = os.geteuid() or GROUP
        monkeypatch.setattr(os, "geteuid", lambda: uid)
        return tmp_path / f"can-bridge-{uid}"

    def test_ours_is_made_and_used(self, fallback: Path) -> None:
        if os.getuid() == 0:
            fallback.mkdir(mode=0o755)
            os.chown(fallback, GROUP, GROUP)
        assert own_socket_path("a") == fallback / "a.sock"
        assert fallback.stat().st_mode & 0o777 == 0o755

    def test_one_that_somebody_else_made_is_refused(
        self, fallback: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        fallback.mkdir()
        owner = fallback.stat().st_uid
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
        monkeypatch.setattr(directories, "FALLBACK_RUNTIME", str(fallback))
        with pytest.raises(StatusError, match=rf"{fallback} belongs to .*XDG_RUNTIME_DIR"):
            own_socket_path("a")

    def test_one_where_others_may_write_is_refused(self, fallback: Path) -> None:
        fallback.mkdir()
        fallback.chmod(0o775)
        if os.getuid() == 0:
            os.chown(fallback, GROUP, GROUP)
        with pytest.raises(StatusError, match="other users may write in"):
            own_socket_path("a")

    def test_a_link_to_one_of_ours_is_refused(self, fallback: Path, tmp_path: Path) -> None:
        ours = tmp_path / "ours"
        ours.mkdir(mode=0o700)
        if os.getuid() == 0:
            os.chown(ours, GROUP, GROUP)
        fallback.symlink_to(ours)
        with pytest.raises(StatusError, match="is no directory"):
            own_socket_path("a")


class TestQuery:
    def test_nobody_there(self, tmp_path: Path) -> None:
        with pytest.raises(NoAnswerError, match=r"no bridge answers on .*: No such file"):
            query(tmp_path / "a.sock")

    def test_one_that_ends_before_it_answers(self, tmp_path: Path) -> None:
        with listening(tmp_path / "a.sock", answer(b"")), pytest.raises(NoAnswerError, match="it ended"):
            query(tmp_path / "a.sock")

    @pytest.mark.parametrize(
        "text",
        [b"no JSON", b"[1]", b"{}", b'{"counters": 1}', b"[" * 100_000, b"\xff"],
        ids=["text", "list", "empty", "number", "deep", "binary"],
    )
    def test_no_bridge(self, tmp_path: Path, text: bytes) -> None:
        with listening(tmp_path / "a.sock", answer(text)), pytest.raises(StatusError, match="is no bridge"):
            query(tmp_path / "a.sock")

    def test_an_answer_without_end_is_not_read_to_the_end(self, tmp_path: Path) -> None:
        sent = 0

        def flood(connection: socket.socket) -> None:
            nonlocal sent
            while sent < 1 << 26:
                sent += connection.send(b" " * 65536)

        with listening(tmp_path / "a.sock", flood), pytest.raises(StatusError, match="is no bridge"):
            query(tmp_path / "a.sock")
        assert sent < 1 << 22

    def test_one_deadline_for_all_of_the_answer(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Each byte comes within the time for one, and all of them in a time that nobody waits."""
        now = 0.0
        monkeypatch.setattr(status.time, "monotonic", lambda: now)

        def drip(connection: socket.socket) -> None:
            nonlocal now
            for _ in range(1000):
                connection.sendall(b" ")
                now += 1.0

        with listening(tmp_path / "a.sock", drip), pytest.raises(NoAnswerError, match="within 5 s"):
            query(tmp_path / "a.sock")

    @pytest.mark.parametrize(
        ("group", "advice"),
        [("root", "ask as .*root"), (status.GROUP, "usermod -aG can-bridge USER"), (None, "ask as")],
    )
    def test_no_permission(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group: str | None, advice: str
    ) -> None:
        def refuse(_path: Path) -> bytes:
            raise PermissionError

        def name_of(_gid: int) -> Any:
            if group is None:
                raise KeyError
            return status.grp.struct_group((group, "x", GROUP, []))

        monkeypatch.setattr(status, "_read_answer", refuse)
        monkeypatch.setattr(status.grp, "getgrgid", name_of)
        (tmp_path / "a.sock").touch()
        with pytest.raises(StatusError, match=rf"no permission for .*{advice}") as caught:
            query(tmp_path / "a.sock")
        assert ("usermod" in str(caught.value)) == (group == status.GROUP)
        with pytest.raises(StatusError, match=r"no permission for .*ask as"):
            query(tmp_path / "none.sock")


class TestText:
    def test_the_state_comes_first_and_each_direction_has_its_drops(self) -> None:
        counters = snapshot()["counters"] | {"tx_dropped": {"queue-full": 3, "stale": 0}}
        assert render(snapshot(counters=counters, uptime_s=7500)).splitlines() == [
            "can232: running, up 2 h 5 min",
            "  adapter     can232 on /dev/ttyUSB0, version V1010, serial number A123, firmware can232",
            "  CAN bus     error-active, TEC 0, REC 3, answers in 0.6 ms",
            "  interface   socketcan vcan0",
            "  received    20 frames from the adapter, 10/s, 0 line errors, 0 adapter overruns",
            "  rx dropped  none",
            "  sent        84 frames to the adapter, 42/s, 1 retries, 0 queued",
            "  tx dropped  queue-full 3",
            "  can-bridge  version 1.2.3",
            "  sent means  taken",
        ]

    def test_what_the_adapter_does_not_vouch_for_is_named_apart(self) -> None:
        apart = {"tx_frames": 1, "tx_queued": 7, "tx_unconfirmed": 2, "tx_late": 3}
        text = render(snapshot(counters=snapshot()["counters"] | apart))
        sent = (
            "  sent        1 frames, 7 queued, 2 unconfirmed, 3 of these perhaps late to the adapter, 42/s,"
        )
        assert sent in text
        assert "sent means" in text
        adapter = snapshot()["adapter"] | {"sent_means": None}
        assert "sent means" not in render(snapshot(adapter=adapter))

    def test_a_port_is_named_with_what_it_is_now(self) -> None:
        adapter = snapshot()["adapter"] | {"port": "usb-serial://A6008isP", "opened": "/dev/ttyUSB3"}
        assert "can232 on usb-serial://A6008isP (/dev/ttyUSB3), version" in render(snapshot(adapter=adapter))
        adapter["opened"] = None
        assert "can232 on usb-serial://A6008isP, version" in render(snapshot(adapter=adapter))

    def test_what_is_not_known(self) -> None:
        bus = snapshot()["bus"] | {"open": False}
        lines = render(
            snapshot(state="idle", reason="no vcan0", bus_state=None, tec=None, bus=bus)
        ).splitlines()
        assert lines[:2] == ["can232: idle, up 9 s", "  reason      no vcan0"]
        assert lines[3:5] == ["  CAN bus     not known", "  interface   socketcan vcan0, NOT OPEN"]

    def test_a_device_does_not_move_the_cursor(self) -> None:
        adapter = snapshot()["adapter"] | {"serial_number": "A\x1b[2J\nroot: running"}
        (line,) = [line for line in render(snapshot(adapter=adapter)).splitlines() if "serial" in line]
        assert r"serial number A\x1b[2J\nroot: running, firmware" in line

    @pytest.mark.parametrize("part", ["adapter", "rates", "uptime_s", "version"])
    def test_one_of_another_version(self, part: str) -> None:
        with pytest.raises(StatusError, match="another version"):
            render(snapshot(**{part: None}) if part != "version" else {"counters": {}})

    @pytest.mark.parametrize(
        ("changes", "text"),
        [
            ({}, "none dropped; the adapter's channel may still be open"),
            ({"channel_open": False}, "none dropped; the adapter's channel is closed"),
            (
                {"channel_open": None, "bus": {"open": False}},
                "none dropped; no adapter was reached",
            ),
            (
                {"counters": {"tx_dropped": {"stale": 2, "full": 3}, "rx_dropped": {"not-running": 1}}},
                "rx dropped: not-running 1; tx dropped: stale 2, full 3; "
                "the adapter's channel may still be open",
            ),
        ],
    )
    def test_farewell(self, changes: dict[str, Any], text: str) -> None:
        counters = snapshot()["counters"] | changes.pop("counters", {})
        told = farewell(snapshot(counters=counters, **changes))
        assert told == f"stopped after 9 s: 20 frames received, 84 sent; {text}"

    def test_durations(self) -> None:
        times = {59.9: "59 s", 61: "1 min 1 s", 3600: "1 h 0 min", 8_640_000 + 7200: "100 d 2 h"}
        assert {seconds: status_text._duration(seconds) for seconds in times} == times
