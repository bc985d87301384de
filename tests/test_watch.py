"""``waldnet watch``: what it prints of a running network, whenever it comes."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from process_helpers import (
    ANY_PORT,
    PATIENCE_S,
    Processes,
    free_endpoint,
    log_entries,
    observe,
    start_center,
    start_nodes,
    variant,
)

from waldnet.common.config import Network
from waldnet.common.transport import open_zenoh
from waldnet.scenarios.catalogue import find

pytestmark = pytest.mark.processes

DECIDED = {0: "confirmed", 1: "deleted", 2: "deleted", 3: "deleted", 4: "deleted"}
LONG = ("duration = 60.0", "duration = 3000.0")


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    with Processes(tmp_path) as started:
        yield started


def decided(entries: list[dict[str, Any]]) -> dict[int, str]:
    return {entry["track"]: entry["kind"] for entry in entries if entry["event"] == "decision"}


def test_to_the_end(processes: Processes) -> None:
    path = find("four-radars")
    center = start_center(processes, path, "--speed", "max", "--wait", PATIENCE_S)
    watches = [
        processes.waldnet("watch", "four-radars", "--connect", *center.at, "--until-end", *how)
        for how in ([], ["--json"])
    ]
    for watch in watches:
        watch.await_line("there")
    nodes = start_nodes(processes, path, "--connect", *center.at)
    assert [process.wait() for process in (*watches, center.process, *nodes.values())] == 7 * [0]
    people, machines = (watch.out for watch in watches)
    assert [watch.err for watch in watches] == [[], []]
    assert "2026-01-01 00:00:02.00Z     2.00 s  track 0 confirmed after 1 scans, log LR +33.33" in people
    assert sum(" deleted after " in line for line in people) == 4
    assert people.count("all sources are exhausted") == 1
    entries = list(log_entries(machines))
    assert decided(entries) == DECIDED
    assert [entry["name"] for entry in entries if entry["event"] == "there"] == ["center"]
    assert [entry for entry in entries if entry["event"] == "end"] == [{"event": "end"}]


def test_whoever_comes_late_sees_how_it_stands(processes: Processes, tmp_path: Path) -> None:
    """And over a router sees the sensors too."""
    path = variant(tmp_path, "long", LONG)
    router = processes.waldnet("router", "--listen", ANY_PORT)
    at = json.loads(router.await_line("listening"))["listening"]
    client = ("--mode", "client", "--connect", *at)
    center = start_center(processes, path, *client, "--speed", "4", "--wait", PATIENCE_S)
    with open_zenoh(Network(mode="client", connect=tuple(at))) as bus:
        observer = observe(bus, path)
        nodes = start_nodes(processes, path, *client)
        observer.await_tracks(lambda tracks: len(tracks.ids) == 1)
    watch = processes.waldnet("watch", path, "--json", *client)
    (track,) = json.loads(watch.await_line('"picture"'))["tracks"]
    assert (track["track"], track["status"]) == (0, "confirmed")
    for number in DECIDED:
        watch.await_line(f'"track": {number}, "time"')
    for name in nodes:
        watch.await_line(f'{{"event": "there", "name": "{name}"}}')
    nodes["radar-1"].signal(signal.SIGKILL)
    watch.await_line('{"event": "gone", "name": "radar-1"}')
    center.process.signal(signal.SIGTERM)
    watch.await_line('{"event": "gone", "name": "center"}')
    watch.signal(signal.SIGINT)
    assert watch.wait() == 0
    assert decided(list(log_entries(watch.out))) == DECIDED
    assert watch.err == []


def test_nobody_is_there(processes: Processes) -> None:
    endpoint = free_endpoint()
    watch = processes.waldnet("watch", "four-radars", "--connect", endpoint)
    line = watch.await_line("no center of network 'four-radars' is there")
    assert f"(peer at {endpoint}); waiting for one" in line
    watch.signal(signal.SIGTERM)
    assert watch.wait() == 0
    client = processes.waldnet("watch", "four-radars", "--mode", "client", "--connect", endpoint)
    assert client.wait() == 1
    assert f"nothing answers at {endpoint}" in client.err[-1]
