"""The network in containers, as docker-compose.yml says: what it decides, and what becomes of it when parts fail."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import pytest
from process_helpers import Observer, Processes, assert_agree, free_endpoint, observe, points, points_of, variant

from waldnet.common.config import Network
from waldnet.common.estimation.sprt import Status
from waldnet.common.messages import Tracks
from waldnet.common.transport import open_zenoh

pytestmark = [pytest.mark.docker, pytest.mark.timeout(540)]

ROOT = Path(__file__).parent.parent
SENSORS = ("radar-1", "radar-2", "radar-3", "radar-4")
#: The target stays in sight for as long as the tests take, and is not deleted because three radars miss it at once; a
#: loaded machine does not make a sensor overdue.
CHANGES = (
    ("duration = 60.0", "duration = 1200.0"),
    ("p_d = 0.9\n", "p_d = 0.99\n"),
    ("psd = 10.0", "psd = 0.1"),
    ("state = [0.0, 0.0, 150.0, 0.0]", "state = [0.0, 0.0, 0.0, 0.0]"),
    ('association = "tight"', 'association = "tight"\nhold_back = 1000.0'),
)


def output(*command: str, env: Mapping[str, str] | None = None) -> str:
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, **(env or {})}, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}: {done.stdout[-3000:]}{done.stderr[-3000:]}"
    return done.stdout


def works(*command: str) -> bool:
    return shutil.which(command[0]) is not None and subprocess.run(command, capture_output=True).returncode == 0


def compose_command() -> tuple[str, ...]:
    """``docker compose``, or the ``docker-compose`` of old; the tests are skipped where there is none, or no engine."""
    commands = [command for command in (("docker", "compose"), ("docker-compose",)) if works(*command, "version")]
    missing = "no Docker engine answers" if not works("docker", "info") else "there is no docker compose"
    if commands and works("docker", "info"):
        return commands[0]
    if "docker" in os.environ.get("WALDNET_MUST_RUN", ""):
        pytest.fail(f"{missing}, and WALDNET_MUST_RUN says docker")
    pytest.skip(missing)


class Project(NamedTuple):
    """docker-compose.yml with an environment."""

    command: tuple[str, ...]
    name: str
    env: Mapping[str, str]

    def __call__(self, *words: str) -> str:
        return output(*self.command, *words, env=self.env)

    def take_down(self) -> None:
        """Nothing of it is left."""
        self("down", "--volumes", "--rmi", "all")
        # What the builder of old keeps of the first stage.
        output("docker", "image", "prune", "--force", "--filter", "label=org.opencontainers.image.title=waldnet")
        label = f"label=com.docker.compose.project={self.name}"
        assert output("docker", "ps", "--all", "--quiet", "--filter", label) == ""
        assert output("docker", "network", "ls", "--quiet", "--filter", label) == ""
        assert output("docker", "images", "--quiet", self.name) == ""


class Containers(NamedTuple):
    """A network in containers, and one who listens to it from outside."""

    compose: Project
    path: Path
    processes: Processes
    observer: Observer

    def container(self, service: str) -> str:
        return self.compose("ps", "--all", "--quiet", service).strip()

    def await_tracks(self, *missing: str, times: int = 3) -> list[Tracks]:
        """Pictures in which all sensors but some contribute to track 0, one after the other."""
        expected = [name not in missing for name in SENSORS]

        def wanted(tracks: Tracks) -> bool:
            return tracks.ids.tolist() == [0] and tracks.contributing[0].tolist() == expected

        pictures = [self.observer.await_tracks(wanted) for _ in range(times)]
        assert {picture.status[0] for picture in pictures} == {Status.CONFIRMED}
        return pictures


@pytest.fixture(scope="module")
def containers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Containers]:
    """All up, in a project of its own; in the end nothing of it is left."""
    command = compose_command()
    folder = tmp_path_factory.mktemp("compose")
    folder.chmod(0o755)  # another user reads it in the containers
    path = variant(folder, "long", *CHANGES)
    project = f"waldnet-test-{uuid.uuid4().hex[:8]}"
    endpoint = free_endpoint()
    env = {
        "COMPOSE_PROJECT_NAME": project,
        "WALDNET_IMAGE": project,
        "WALDNET_PORT": endpoint.rsplit(":", 1)[1],
        "WALDNET_SCENARIOS": str(folder),
        "WALDNET_SCENARIO": path.name,
        "WALDNET_SPEED": "4",
        "WALDNET_WAIT": "60",
    }
    compose = Project(command, project, env)
    with ExitStack() as stack:
        processes = stack.enter_context(Processes(folder))
        stack.callback(compose.take_down)
        compose("build")
        compose("up", "-d", "router", "center")
        bus = stack.enter_context(open_zenoh(Network(mode="client", connect=(endpoint,))))
        observer = observe(bus, path)
        compose("up", "-d")
        all_up = Containers(compose, path, processes, observer)
        all_up.await_tracks()
        yield all_up


def test_decides_as_a_replay_does(containers: Containers) -> None:
    last_ns = containers.await_tracks(times=10)[-1].time_ns
    record = containers.observer.record
    got = {key: point for key, point in points_of(record).items() if key[0] <= record.scenario.to_seconds(last_ns)}
    replayed = points(containers.processes.output("replay", containers.path, "--json"))
    assert_agree(got, {key: point for key, point in replayed.items() if key in got})
    assert [got[2.0, track].status for track in range(5)] == ["confirmed", *4 * ["deleted"]]
    decided = {decision.track: decision.kind for decision in record.decisions}
    assert decided == {0: "confirmed", **dict.fromkeys(range(1, 5), "deleted")}
    said = [
        json.loads(line)
        for line in containers.compose("logs", "--no-color", "--no-log-prefix", "center").splitlines()
        if line.startswith("{")
    ]
    assert {entry["track"]: entry["event"] for entry in said if "track" in entry} == decided
    assert " 2.00 s  track 0 confirmed" in containers.compose("logs", "--no-color", "watch")


def test_all_are_healthy(containers: Containers) -> None:
    service = '{{index .Actor.Attributes "com.docker.compose.service"}} {{.Action}}'
    label = f"label=com.docker.compose.project={containers.compose.name}"
    since = str(int(time.time()) - 300)
    filters = ("--filter", label, "--filter", "event=health_status")
    events = containers.processes.start("docker", "events", "--since", since, *filters, "--format", service)
    for name in ("router", "center", "watch", *SENSORS):
        events.await_line(f"{name} health_status: healthy")


def test_a_sensor_that_is_stopped_is_not_missed(containers: Containers) -> None:
    containers.compose("stop", "radar-4")
    first, *_, last = containers.await_tracks("radar-4")
    assert (first.x[0] != last.x[0]).any()
    lost = [line for line in containers.compose("logs", "--no-color", "center").splitlines() if "sensor lost" in line]
    assert "radar-4" in lost[-1]
    containers.compose("start", "radar-4")
    containers.await_tracks()


def test_a_sensor_that_is_cut_off_takes_part_again(containers: Containers) -> None:
    network, container = f"{containers.compose.name}_default", containers.container("radar-3")
    output("docker", "network", "disconnect", network, container)
    containers.await_tracks("radar-3")
    output("docker", "network", "connect", network, container)
    containers.await_tracks()


def test_a_sensor_that_is_killed_is_restarted(containers: Containers) -> None:
    kill = "import os, signal; os.kill(-1, signal.SIGKILL)"
    subprocess.run(("docker", "exec", containers.container("radar-2"), "python", "-c", kill), capture_output=True)
    containers.await_tracks("radar-2", times=1)
    containers.await_tracks()


def test_a_router_that_is_restarted_finds_all_again(containers: Containers) -> None:
    containers.compose("restart", "router")
    containers.observer.await_center(alive=False)
    containers.observer.await_center(alive=True)
    containers.await_tracks()


def test_all_end_when_told_to(containers: Containers) -> None:
    containers.compose("stop")
    for name in ("router", "center", "watch", *SENSORS):
        code = output("docker", "inspect", "--format", "{{.State.ExitCode}}", containers.container(name))
        assert code.strip() == "0", name
