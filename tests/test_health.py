"""Health: the answer comes from the process's own loop, and whoever asks learns what is wrong."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from process_helpers import ANY_PORT, PATIENCE_S, Processes, start_center, variant

from waldnet.common import health
from waldnet.common.errors import TransportError
from waldnet.common.health import answering
from waldnet.common.inbox import Asked, Inbox, Stopped


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "health"


@contextmanager
def answers(path: Path, answer: health.Health) -> Iterator[None]:
    """A process that is as told."""
    inbox = Inbox()

    def loop() -> None:
        while not isinstance(incoming := inbox.receive(None), Stopped):
            assert isinstance(incoming, Asked)
            incoming.answer(answer)

    thread = threading.Thread(target=loop)
    thread.start()
    with answering(path, inbox.asked):
        yield
    inbox.stop()
    thread.join()


@pytest.mark.parametrize(
    ("answer", "options", "fault"),
    [
        ({"linked": True}, [], None),
        ({"linked": False}, [], "not linked to its network"),
        ({"linked": True, "last_report_s": 2.0}, ["--max-age", "3"], None),
        ({"linked": True, "last_report_s": 4.0}, ["--max-age", "3"], "no report for 3 s"),
        ({"linked": True, "last_report_s": None}, ["--max-age", "3"], "no report for 3 s"),
        ({"linked": False, "last_report_s": 1.0}, ["--max-age", "3"], "not linked to its network"),
    ],
)
def test_what_is_wrong(
    path: Path, answer: health.Health, options: list[str], fault: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    with answers(path, answer):
        code = health.main([str(path), *options])
    assert code == int(fault is not None)
    assert json.loads(capsys.readouterr().out) == ({"fault": fault} if fault else {}) | answer


def test_a_loop_that_is_stuck_is_told_from_one_that_ended(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(health, "_PATIENCE_S", 0.1)
    with answering(path, Inbox().asked):
        assert health.main([str(path)]) == 1
    assert "does not answer: it is stuck" in capsys.readouterr().out
    assert health.main([str(path)]) == 1
    assert "No such file" in capsys.readouterr().out


def test_wrong_words(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert health.main([]) == 2
    assert "usage" in capsys.readouterr().err
    assert health.main([str(path), "--max-age", "soon"]) == 1
    assert "soon" in capsys.readouterr().out


def test_what_a_killed_process_left_is_replaced_and_removed(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with answers(path, {"linked": True}):
        assert health.ask(str(path)) == {"linked": True}
    assert not path.exists()


def test_a_path_that_is_taken_stays_as_it_is(path: Path) -> None:
    with answers(path, {"linked": True}):
        with pytest.raises(TransportError, match=f"health at {path}: .*in use"), answering(path, Inbox().asked):
            pass
        assert health.ask(str(path)) == {"linked": True}
    path.write_text("precious")
    with pytest.raises(TransportError, match="in use"), answering(path, Inbox().asked):
        pass
    assert path.read_text() == "precious"


def test_one_who_hangs_up_does_not_deafen(path: Path) -> None:
    with answers(path, {"linked": True}):
        for _ in range(20):
            with socket.socket(socket.AF_UNIX) as client:
                client.connect(str(path))
        assert health.ask(str(path)) == {"linked": True}


def test_asking_is_light() -> None:
    """Many small machines ask every few seconds."""
    heavy = (
        "import sys, common.health; print([m for m in ('numpy', 'zenoh', 'structlog', 'argparse') if m in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", heavy], text=True).strip() == "[]"


@pytest.mark.processes
def test_all_processes_answer(tmp_path: Path) -> None:
    path = variant(tmp_path, "long", ("duration = 60.0", "duration = 600.0"))
    sockets = {name: tmp_path / f"{name}.socket" for name in ("router", "center", "watch", "radar-1")}
    with Processes(tmp_path) as processes:
        router = processes.waldnet("router", "--listen", ANY_PORT, "--health", sockets["router"])
        client = ("--mode", "client", "--connect", *json.loads(router.await_line("listening"))["listening"])
        center = start_center(
            processes, path, *client, "--health", sockets["center"], "--speed", "4", "--wait", PATIENCE_S
        )
        watch = processes.waldnet("watch", path, *client, "--health", sockets["watch"])
        watch.await_line("the center is there")
        linked = {name: health.ask(str(sockets[name]))["linked"] for name in ("router", "center", "watch")}
        assert linked == {"router": True, "center": False, "watch": True}
        options = (*client, "--health", sockets["radar-1"])
        nodes = {"radar-1": processes.waldnet("node", path, "radar-1", *options)}
        for name in ("radar-2", "radar-3", "radar-4"):
            nodes[name] = processes.waldnet("node", path, name, *client)
        watch.await_line("track 0 confirmed")
        found = {name: health.ask(str(place)) for name, place in sockets.items()}
        assert [health.fault(found[name], 30.0) for name in ("center", "radar-1")] == [None, None]
        assert found["center"]["sensors"] == list(nodes)
        assert found["radar-1"]["scans"] > 0
        assert len(found["router"]["there"]) == 5
        everybody = [*nodes.values(), watch, center.process, router]
        for process in everybody:
            process.signal(signal.SIGTERM)
        assert [process.wait() for process in everybody] == 7 * [0]
        assert not any(place.exists() for place in sockets.values())
