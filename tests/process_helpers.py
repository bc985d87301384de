"""Real processes for tests: started by one manager that finds and ends every one of them, children of children too."""

from __future__ import annotations

import json
import os
import select
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from waldnet.common.codec import decode
from waldnet.common.config import Network, Scenario, load_scenario
from waldnet.common.inbox import Heard, Inbox, Present
from waldnet.common.messages import Keys, Tracks
from waldnet.common.transport import Bus, open_zenoh
from waldnet.recording.lines import TrackLines
from waldnet.recording.record import Record
from waldnet.scenarios.catalogue import find

#: Nothing takes so long, even on a busy machine; whoever waits longer waits in vain. Less than a test may take.
PATIENCE_S = 120.0
WALDNET = str(Path(sys.executable).with_name("waldnet"))
ANY_PORT = "tcp/127.0.0.1:0"
_MARK = "WALDNET_TEST_FAMILY"


class Process:
    """A process whose output is read as it comes."""

    def __init__(self, command: list[str], family: str, cwd: Path) -> None:
        self._child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=cwd,
            env={**os.environ, _MARK: family},
        )
        self._news = threading.Condition()
        self._lines: dict[str, list[str]] = {"out": [], "err": []}
        self._open = {"out", "err"}
        self._readers = [
            threading.Thread(target=self._read, args=(name, pipe), daemon=True)
            for name, pipe in (("out", self._child.stdout), ("err", self._child.stderr))
        ]
        for reader in self._readers:
            reader.start()

    @property
    def out(self) -> list[str]:
        """Lines of standard output so far."""
        return list(self._lines["out"])

    @property
    def err(self) -> list[str]:
        """Lines of standard error so far."""
        return list(self._lines["err"])

    @property
    def pid(self) -> int:
        """Process id."""
        return self._child.pid

    def await_line(self, text: str, number: int = 1) -> str:
        """The first line of standard output that contains ``text``, or a later one, as soon as it is there."""
        return self._await("out", text, number)

    def await_log(self, text: str) -> str:
        """The first line of standard error that contains ``text``, as soon as it is there."""
        return self._await("err", text)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal."""
        self._child.send_signal(number)

    def wait(self) -> int:
        """The exit code, once the process has ended and everything it said is read."""
        code = self._child.wait(PATIENCE_S)
        for reader in self._readers:
            reader.join(PATIENCE_S)
        return code

    def reap(self) -> None:
        """End it if it has not ended, and give back what it held."""
        self._child.kill()
        self._child.wait()
        for reader in self._readers:
            reader.join(PATIENCE_S)
        for pipe in (self._child.stdout, self._child.stderr):
            assert pipe is not None
            pipe.close()

    def _read(self, name: str, pipe: Any) -> None:
        for line in pipe:
            with self._news:
                self._lines[name].append(line.rstrip("\n"))
                self._news.notify_all()
        with self._news:
            self._open.discard(name)
            self._news.notify_all()

    def _await(self, name: str, text: str, number: int = 1) -> str:
        def found() -> str | None:
            return next(iter([line for line in self._lines[name] if text in line][number - 1 :]), None)

        with self._news:
            self._news.wait_for(lambda: found() is not None or name not in self._open, PATIENCE_S)
        line = found()
        assert line is not None, f"never said {text!r}: {self.out} {self.err}"
        return line


class Processes:
    """All processes of a test; a context manager that leaves none behind, whoever started it."""

    def __init__(self, cwd: Path) -> None:
        self.cwd = cwd
        self._family = uuid.uuid4().hex
        self._started: list[Process] = []

    def waldnet(self, *arguments: object) -> Process:
        """Start ``waldnet`` with arguments."""
        return self.start(WALDNET, *map(str, arguments))

    def run(self, scenario: object, *arguments: object) -> Process:
        """Start ``waldnet run`` of a network that waits for all its sensors, however slowly they start."""
        return self.waldnet("run", scenario, *arguments, "--wait", PATIENCE_S)

    def start(self, *command: str) -> Process:
        """Start a command."""
        self._started.append(Process(list(command), self._family, self.cwd))
        return self._started[-1]

    @staticmethod
    def command(*arguments: object) -> str:
        """The same as ``waldnet`` starts, for a shell."""
        return shlex.join([WALDNET, *map(str, arguments)])

    def output(self, *arguments: object) -> list[str]:
        """What ``waldnet`` with arguments prints."""
        process = self.waldnet(*arguments)
        assert process.wait() == 0, process.err
        return process.out

    def alive(self) -> dict[int, list[str]]:
        """Command lines of all processes of this family, by process id; those of a launcher's children too."""
        mark = f"{_MARK}={self._family}".encode()
        return {pid: command for pid in _pids() if (command := _command_of(pid, mark))}

    def pid(self, *words: str) -> int:
        """The process whose command line has these words."""
        (pid,) = [pid for pid, command in self.alive().items() if set(words) <= set(command)]
        return pid

    def kill(self, *words: str) -> None:
        """Kill the process whose command line has these words."""
        os.kill(self.pid(*words), signal.SIGKILL)

    def await_end(self, pids: dict[int, list[str]]) -> None:
        """Wait until processes that are not our children have ended."""
        until = time.monotonic() + PATIENCE_S
        for pid in pids:
            try:
                handle = os.pidfd_open(pid)
            except ProcessLookupError:
                continue
            try:
                ended, _, _ = select.select([handle], [], [], until - time.monotonic())
                assert ended, f"still running: {pids[pid]}"
            finally:
                os.close(handle)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for pid in self.alive():
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        for process in self._started:
            process.reap()


def _pids() -> list[int]:
    return [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit()]


def _command_of(pid: int, mark: bytes) -> list[str]:
    """The command line of a process with the mark in its environment; nothing of others, and of those that ended."""
    try:
        if mark not in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0"):
            return []
        return Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    except OSError:
        return []


class Point(NamedTuple):
    """What is compared of a track at a time."""

    status: str
    log_lr: float
    log_lr_total: float
    x: list[float]


def points(lines: list[str]) -> dict[tuple[float, int], Point]:
    """Tracks as JSON Lines, by time and track."""
    entries = [json.loads(line) for line in lines]
    return {(entry["time"], entry["track"]): Point(*(entry[name] for name in Point._fields)) for entry in entries}


def points_of(record: Record) -> dict[tuple[float, int], Point]:
    """The same of everything that was heard."""
    lines = TrackLines(record.scenario)
    return points([line for time_ns in sorted(record.pictures) for line in lines.of(record.pictures[time_ns])])


def assert_agree(
    got: dict[tuple[float, int], Point], expected: dict[tuple[float, int], Point], *, last_only: bool = False
) -> None:
    """Every track at every time, or only at the last: status, log LR to 1e-6, state."""
    if last_only:
        last = max(time_s for time_s, _ in expected)
        assert max(time_s for time_s, _ in got) == last
        got, expected = ({key: p for key, p in some.items() if key[0] == last} for some in (got, expected))
    assert got.keys() == expected.keys()
    for key, point in expected.items():
        assert got[key].status == point.status, key
        np.testing.assert_allclose(got[key].log_lr, point.log_lr, rtol=0, atol=1e-6, err_msg=str(key))
        np.testing.assert_allclose(got[key].log_lr_total, point.log_lr_total, rtol=0, atol=1e-6, err_msg=str(key))
        np.testing.assert_allclose(got[key].x, point.x, rtol=1e-9, atol=1e-6, err_msg=str(key))


class Observer:
    """Hears what a center tells everybody."""

    def __init__(self, bus: Bus, scenario: Scenario, network: str) -> None:
        self.bus, self.keys, self.record = bus, Keys(network), Record(scenario)
        self._inbox = Inbox()
        for key in (self.keys.tracks(), self.keys.decision()):
            bus.subscribe(key, self._inbox.heard)
        bus.watch(self.keys.center_alive(), self._inbox.present)
        self.await_center(alive=True)
        self.fence()

    def fence(self) -> None:
        """Return once the center has taken in all that was declared and said before."""
        assert self.bus.ask(self.keys.picture(), PATIENCE_S), "the center does not answer"

    def await_center(self, *, alive: bool) -> None:
        """Return once the center is there, or gone."""
        self._until(lambda news: isinstance(news, Present) and news.alive == alive)

    def await_tracks(self, wanted: Callable[[Tracks], bool]) -> Tracks:
        """The next picture that is as wanted."""
        found: list[Tracks] = []

        def good(news: object) -> bool:
            if isinstance(news, Tracks) and wanted(news):
                found.append(news)
            return bool(found)

        self._until(good)
        return found[0]

    def follow_to_the_end(self) -> Record:
        """Everything until the center leaves; then what is still on its way."""
        self.await_center(alive=False)
        self.bus.close()
        while not self._inbox.empty:
            self._next()
        return self.record

    def _until(self, enough: Callable[[object], bool]) -> None:
        until_ns = time.time_ns() + round(PATIENCE_S * 1e9)
        while not enough(self._next(until_ns)):
            assert time.time_ns() < until_ns, "waited in vain"

    def _next(self, until_ns: int | None = None) -> object:
        news = self._inbox.receive(until_ns)
        if isinstance(news, Heard):
            message = decode(news.key, news.payload)
            self.record.note(message)
            return message
        return news


class Center(NamedTuple):
    """A center that listens."""

    process: Process
    at: tuple[str, ...]


def start_center(processes: Processes, scenario: object, *options: object) -> Center:
    """Start a center, on a free port unless the options say how it takes part."""
    how = () if "--connect" in options else ("--listen", ANY_PORT)
    process = processes.waldnet("center", scenario, *how, *options)
    return Center(process, tuple(json.loads(process.await_line("listening"))["listening"]))


def start_nodes(processes: Processes, path: Path, *options: object) -> dict[str, Process]:
    """Start a node for every sensor of a scenario."""
    names = load_scenario(path).sensor_names
    return {name: processes.waldnet("node", path, name, *options) for name in names}


def observe(bus: Bus, path: Path, network: str | None = None) -> Observer:
    """Listen to a center that the bus reaches."""
    scenario = load_scenario(path)
    return Observer(bus, scenario, network or scenario.network.name)


def peer_of(at: tuple[str, ...]) -> Bus:
    """A bus that connects to a process that listens."""
    return open_zenoh(Network(connect=at))


def variant(folder: Path, name: str, *changes: tuple[str, str], of: str = "four-radars") -> Path:
    """A scenario that comes along, with text replaced."""
    text = find(of).read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / f"{name}.toml"
    path.write_text(text.replace(f'name = "{of}"', f'name = "{name}"', 1), encoding="utf-8")
    return path


def free_endpoint() -> str:
    """An endpoint on a port that is free now."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


def log_entries(lines: list[str]) -> Iterator[dict[str, Any]]:
    """Log lines in JSON."""
    return (json.loads(line) for line in lines)
