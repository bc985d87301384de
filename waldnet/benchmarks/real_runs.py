"""Real scenarios, tracked by waldnet and by a peer on the same plots, and judged by the truth: docs/real-runs.md.

    python -m waldnet.benchmarks.real_runs SCENARIO          # track anew: a table, and docs/images/SCENARIO.png
    python -m waldnet.benchmarks.real_runs SCENARIO --kept   # judge and draw again what was tracked last
    python -m waldnet.benchmarks.real_runs overview          # what was found last; tracks scenarios that were not yet

Every tracker is a process of its own that writes its tracks to runs/real/SCENARIO; its computing time is all that it
took of a processor, start included. The peer's tracks are kept as long as nothing changes that it depends on.
``python -m waldnet.benchmarks.figures docs/real-runs.md SCENARIO overview`` puts it into the docs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import resource
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from waldnet.benchmarks.machine import described
from waldnet.benchmarks.peer_tracker import early
from waldnet.benchmarks.real_figure import draw
from waldnet.benchmarks.real_truth import rules_of, times_of, truth_of
from waldnet.common.config import Scenario, load_scenario
from waldnet.common.messages import Scan
from waldnet.evaluation.evaluation import Evaluation, judge
from waldnet.evaluation.paths import targets_at
from waldnet.evaluation.runs import read_run
from waldnet.evaluation.table import SUMMARY, said
from waldnet.scenarios.catalogue import find
from waldnet.sensor_node.sources import all_scans

SCENARIOS = (*(f"autoferry-{number}-all" for number in (2, 3, 5, 13, 16)), "joyride", "solent")
OUT, IMAGES = Path("runs/real"), Path("docs/images")
#: Simulated scenarios are looked at for so long, or a peer would take most of the time of all.
_DURATION_S = 600.0
#: A track is reported late where it must be so improbable that it is false; latest: with the smallest GOSPA.
_LATE_P0 = {"late": 1e-10, "latest": 1e-30}
PEER, EARLY_PEER = "Stone Soup", "Stone Soup, early"

#: More rows of a table, and after which of the summary's.
_MORE = {"  after [s], mean": ("  after [radar scans]", "{confirmed_after_radar_scans:.1f}")}
_LAST = (("computing time [s]", "{cpu_s:.0f}"),)

#: Columns of the overview.
_OVERVIEW = (
    ("GOSPA [m]", "{gospa_m[total]:.1f}"),
    ("localisation", "{gospa_m[localisation]:.1f}"),
    ("missed", "{gospa_m[missed]:.1f}"),
    ("false", "{gospa_m[false]:.1f}"),
    ("OSPA(2) [m]", "{ospa2_m[total]:.1f}"),
    ("confirmed", "{confirmed_targets} of {targets}"),
    ("after [s]", "{confirmed_after_s:.1f}"),
    ("radar scans", "{confirmed_after_radar_scans:.1f}"),
    ("held", "{held_share:.1%}"),
    ("breaks", "{breaks}"),
    ("swaps", "{swaps}"),
    ("false tracks", "{false_tracks}"),
    ("per minute", "{false_tracks_per_minute:.2f}"),
    ("RMSE [m]", "{rmse_m:.1f}"),
    ("CPU [s]", "{cpu_s:.0f}"),
)


class Tracked(NamedTuple):
    """What a tracker made of a scenario.

    Attributes:
        evaluation: of its confirmed tracks.
        summary: what tables say of it.
    """

    evaluation: Evaluation
    summary: dict[str, Any]


def trackers(scenario: Scenario, file: Path, folder: Path) -> dict[str, list[str]]:
    """The commands that track a scenario and print tracks as JSON lines, by the tracker's name.

    Args:
        scenario: to track.
        file: of the scenario.
        folder: to write a scenario to that has no bearings.
    """
    waldnet = str(Path(sys.executable).with_name("waldnet"))
    peers = {PEER: [sys.executable, "-m", "waldnet.benchmarks.peer_tracker", str(file)]}
    if changes := early(scenario):
        peers[EARLY_PEER] = [*peers[PEER], *(word for change in changes for word in ("--set", change))]
    if scenario.initiation is None and not scenario.hypotheses:
        return peers  # nothing would start a track
    commands = {
        name: [waldnet, "replay", str(path), "--json"] for name, path in variants(scenario, file, folder).items()
    }
    told = subprocess.run([waldnet, "replay", "--help"], capture_output=True, text=True, check=True).stdout
    if "--centralised" in told:
        commands["waldnet, centralised"] = [*commands["waldnet"], "--centralised"]
    return commands | peers


def shorter(file: Path, folder: Path) -> Path:
    """The file of a scenario; where it is simulated, one that is like it and ends sooner."""
    scenario = load_scenario(file)
    if scenario.simulation is None or scenario.simulation.duration <= _DURATION_S:
        return file
    text = re.sub(r"^duration = .*$", f"duration = {_DURATION_S}", file.read_text(encoding="utf-8"), flags=re.MULTILINE)
    if scenario.simulation.truth is not None:
        truth = f"truth = {json.dumps(str(scenario.simulation.truth.resolve()))}"
        text = re.sub(r"^truth = .*$", lambda _: truth, text, flags=re.MULTILINE)
    written = folder / "shorter.toml"
    written.write_text(text, encoding="utf-8")
    return written


def variants(scenario: Scenario, file: Path, folder: Path) -> dict[str, Path]:
    """The scenario, and others like it: without bearings, without clutter maps, and with tracks that are reported late.

    Args:
        scenario: to track.
        file: of the scenario.
        folder: to write the others to.
    """
    found, text = {"waldnet": file}, file.read_text(encoding="utf-8")

    def write(name: str, changed: str, ignored: Sequence[str] = ()) -> None:
        assert scenario.recording is not None
        plots = json.dumps(str(scenario.recording.plots.resolve()))
        recording = f"[recording]\nplots = {plots}\nignore = {json.dumps(ignored)}\n"
        found[f"waldnet, {name}"] = folder / f"{name.replace(' ', '-')}.toml"
        changed = re.sub(r"\[recording\]\nplots = .*\n", lambda _: recording, changed)
        found[f"waldnet, {name}"].write_text(changed, encoding="utf-8")

    if scenario.recording is None:
        return found
    head, *sensors = text.split("[[sensor]]")
    if bearings := [sensor.name for sensor in scenario.sensors if sensor.kind == "bearing"]:
        kept = [sensor for sensor in sensors if 'kind = "bearing"' not in sensor]
        write("no bearings", "[[sensor]]".join([head, *kept]), bearings)
    if any(sensor.clutter_map is not None for sensor in scenario.sensors):
        write("no clutter maps", re.sub(r"^clutter_map = .*\n", "", text, flags=re.MULTILINE))
    for name, p0 in _LATE_P0.items():
        write(name, re.sub(r"^p0 = .*$", f"p0 = {p0}", text, flags=re.MULTILINE))
    return found


def track(
    name: str, command: Sequence[str], folder: Path, kept_for: str | None, *, kept: bool = False
) -> tuple[Path, float]:
    """Run a tracker.

    Args:
        name: of the tracker.
        command: prints its tracks.
        folder: to write them to.
        kept_for: on what the tracks depend: those of before are taken if it is the same; None: they are not.
        kept: take those of before anyway.

    Returns:
        the file of tracks, and the seconds of a processor that they took.
    """
    file = folder / f"{name.lower().replace(', ', '-').replace(' ', '-')}.jsonl"
    note = file.with_suffix(".note.json")
    if note.exists():
        told = json.loads(note.read_text())
        if kept or (kept_for is not None and told["kept_for"] == kept_for):
            return file, float(told["cpu_s"])
    note.unlink(missing_ok=True)
    before = _children_s()
    # One thread: several are no faster with matrices of four rows, and would count as computing time.
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with file.open("w") as out:
        subprocess.run(command, stdout=out, check=True, env=environment)
    cpu_s = _children_s() - before
    note.write_text(json.dumps({"kept_for": kept_for, "cpu_s": cpu_s}) + "\n")
    return file, cpu_s


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _peer_depends_on(scenario: Scenario, command: Sequence[str]) -> str:
    """A digest of plots, settings, code and version; of decision and fusion the peer knows nothing."""
    speed = None if scenario.initiation is None else scenario.initiation.speed
    told = scenario.model_dump_json(include={"epoch", "motion", "sensors", "simulation"})
    plots = b"" if scenario.recording is None else scenario.recording.plots.read_bytes()
    source = b"".join(Path(__file__).with_name(f"{name}.py").read_bytes() for name in ("peer_models", "peer_tracker"))
    whole = f"{told} {speed} {command[4:]} {version('stonesoup')}".encode() + plots + source
    return hashlib.sha256(whole).hexdigest()[:16]


def play(name: str, *, kept: bool = False) -> dict[str, Tracked]:
    """Track a scenario with all trackers, draw the figure, and note what was found.

    Args:
        name: of the scenario.
        kept: take all tracks as they were, where they are there.
    """
    folder = OUT / name
    folder.mkdir(parents=True, exist_ok=True)
    file = shorter(find(name), folder)
    scenario = load_scenario(file)
    scans, found = all_scans(scenario), {}
    for tracker, command in trackers(scenario, file, folder).items():
        print(f"{name}: {tracker}", file=sys.stderr)
        same = _peer_depends_on(scenario, command) if tracker in (PEER, EARLY_PEER) else None
        lines, cpu_s = track(tracker, command, folder, same, kept=kept)
        found[tracker] = _judged(scenario, scans, tracker, lines, cpu_s)
    noted = {tracker: each.summary for tracker, each in found.items()}
    (folder / "summary.json").write_text(json.dumps(noted, indent=1) + "\n")
    draw(scenario, scans, [each.evaluation for each in found.values()], IMAGES / f"{name}.png")
    return found


def _judged(scenario: Scenario, scans: Sequence[Scan], tracker: str, lines: Path, cpu_s: float) -> Tracked:
    """Judge a tracker at all times at which any sensor scanned."""
    known, rules = truth_of(scenario), rules_of(scenario)
    times_s = times_of(scenario, scans, known)
    d = scenario.motion.dimensions
    run = read_run(lines, d)._replace(name=tracker)
    evaluation = judge(run, targets_at(known, times_s, rules.gap_s, d), times_s, rules)
    radar_s = max(sensor.scan_interval for sensor in scenario.sensors if sensor.locates)
    summary = evaluation.summary()
    after_s = summary["confirmed_after_s"]
    more = {"confirmed_after_radar_scans": None if after_s is None else after_s / radar_s, "cpu_s": cpu_s}
    return Tracked(evaluation, {**summary, **more})


def table(summaries: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """All measures of a scenario, a column for each tracker."""
    yield f"| | {' | '.join(summaries)} |"
    yield "|---" + "|---:" * len(summaries) + "|"
    rows = [row for head, form in SUMMARY for row in ((head, form), _MORE.get(head)) if row is not None]
    for head, form in (*rows, *_LAST):
        shown = head.replace("  ", "&nbsp;&nbsp;")
        yield f"| {shown} | {' | '.join(said(form, dict(summary)) for summary in summaries.values())} |"


def overview() -> Iterator[str]:
    """The most important measures of all scenarios, a row for each tracker."""
    yield f"| scenario | tracker | {' | '.join(head for head, _ in _OVERVIEW)} |"
    yield "|---|---" + "|---:" * len(_OVERVIEW) + "|"
    for name in SCENARIOS:
        file = OUT / name / "summary.json"
        if not file.exists():
            play(name)
        for tracker, summary in json.loads(file.read_text()).items():
            yield f"| {name} | {tracker} | {' | '.join(said(form, summary) for _, form in _OVERVIEW)} |"


def main() -> None:
    """Print the table of one scenario, or the overview."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=(*SCENARIOS, "overview"))
    parser.add_argument("--kept", action="store_true", help="judge and draw again what was tracked last")
    arguments = parser.parse_args()
    what: str = arguments.what
    if what == "overview":
        print(*overview(), sep="\n")
        return
    found = play(what, kept=arguments.kept)
    print(described("waldnet", "numpy", "stonesoup"), end="\n\n")
    print(*table({tracker: each.summary for tracker, each in found.items()}), sep="\n")
    print(f"\n![plots, truth and confirmed tracks of {what}](images/{what}.png)")


if __name__ == "__main__":
    main()
