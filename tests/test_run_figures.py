"""Figures and summary of a run with far more tracks than targets."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from builders import scenario, sensor_table, write_report

from waldnet.offline.replay import Replay
from waldnet.recording import figures, sketch
from waldnet.recording.record import Record
from waldnet.scenarios.world import simulate_all


def test_of_many_tracks_those_that_were_confirmed_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    boats = [{"state": [-1000.0, 0.0, 60.0, 0.0]}, {"state": [2000.0, 3000.0, 0.0, -80.0]}]
    sensors = [sensor_table("a", false_plots=5.0), sensor_table("b", first_scan=1.0, false_plots=5.0)]
    plot = scenario(*sensors, initiation={"speed": 100.0}, hypothesis=[], target=boats, decision={"p1": 0.9999})
    record = Record(plot)
    for message in Replay(plot, simulate_all(plot, 1)).run():
        record.note(message)
    tracks = {track for picture in record.pictures.values() for track in picture.ids.tolist()}
    confirmed = {decision.track for decision in record.standing() if decision.kind == "confirmed"}
    assert len(confirmed) < len(tracks)
    assert set(sketched(record).histories()) == tracks
    monkeypatch.setattr(sketch, "MOST_TRACKS", 3)
    assert set(sketched(record).histories()) == confirmed
    labels = [handle.get_label() for handle in figures._status_handles(sketched(record))]
    assert f"{len(tracks) - len(confirmed)} never confirmed, not drawn" in labels
    write_report(record, tmp_path, {})
    told = json.loads((tmp_path / "decisions.json").read_text())
    for entry in told["tracks"]:
        own = [decision for decision in record.standing() if decision.track == entry["track"]]
        assert [decision["kind"] for decision in entry["decisions"]] == [decision.kind for decision in own]
    assert (tmp_path / "log_lr.png").read_bytes().startswith(b"\x89PNG")


def sketched(record: Record) -> sketch.Sketch:
    drawn = sketch.Sketch(record.scenario)
    for time_ns in sorted(record.pictures):
        drawn.add_picture(record.pictures[time_ns])
    return drawn
