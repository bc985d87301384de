"""The command line ``waldnet``."""

from __future__ import annotations

import json
import sys
import warnings
from contextlib import nullcontext
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from textwrap import fill
from typing import Annotated

from cyclopts import App, Parameter

from waldnet.common.config import Network, Scenario, load_scenario
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.sprt import Status
from waldnet.common.files import replacing_text
from waldnet.common.logs import LogFormat, configure
from waldnet.common.messages import Tracks
from waldnet.common.process import HealthSocket, NetworkOptions, Seconds, Seed, Speed, Verbose
from waldnet.common.process import main as run_app
from waldnet.scenarios.catalogue import find, names

#: Commands that are imported when they are called: module and function, and what the help says.
_ELSEWHERE = {
    "waldnet.benchmarks.cli:bench": "Measure a network on this machine: latency, bandwidth, precision, tracks, load.",
    "waldnet.evaluation.cli:evaluate": "Tell how well a recorded run found its targets.",
    "waldnet.fusion_center.app:center": "Run the fusion center: order reports, compute the likelihood ratio, decide.",
    "waldnet.launch.measuring:measure": "Measure what the sensors of a recording are like.",
    "waldnet.sensor_node.app:node": "Run one sensor: filter its scans and report to the fusion center.",
    "waldnet.studies.cli:study": "Monte Carlo: modes of fusion side by side on the same plots.",
}

app = App(
    name="waldnet",
    version=version("waldnet"),
    help="Sensors decide together, by Wald's sequential test, which tracks are real.",
)
for _path, _help in _ELSEWHERE.items():
    app.command(_path, help=_help)


@app.command
def run(
    scenario: str,
    *,
    plots: Path | None = None,
    seed: Seed | None = None,
    speed: Speed = 1.0,
    out: Path | None = None,
    wait: Seconds = 10.0,
    verbose: Verbose = False,
) -> None:
    """Run all processes of a network on this machine, and write a report.

    Args:
        scenario: scenario file, or name of one that comes along (see: waldnet scenarios).
        plots: recorded plots (JSON Lines) instead of the scenario's.
        seed: of the simulated world, instead of the scenario's.
        speed: seconds of measurement time per second; max: as fast as all go together.
        out: folder of the report, which must not hold one yet; default runs/SCENARIO-TIME.
        wait: seconds to wait for the others once a sensor has joined, more on a busy machine.
        verbose: tell and log decisions on tracks that were never confirmed too.
    """
    from rich.console import Console

    from waldnet.launch.checks import warn
    from waldnet.launch.run import Order, default_folder, execute
    from waldnet.sensor_node.sources import all_scans, recording_of, seed_of

    path = find(scenario)
    loaded = load_scenario(path)
    plots = plots.resolve() if plots else None
    scans = all_scans(loaded, plots=plots, seed=seed)
    warn(loaded, scans, recording_of(loaded, plots))
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    order = Order(
        scenario=loaded,
        path=path.resolve(),
        plots=plots,
        seed=seed_of(loaded, seed),
        speed=speed,
        out=out or default_folder(loaded.name, stamp),
        scans=scans,
        wait_s=wait,
        verbose=verbose,
    )
    execute(order, Console(stderr=False, highlight=False))


@app.command
def replay(
    scenario: str,
    plots: Path | None = None,
    *,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
    lag: Seconds | None = None,
    centralised: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Work through recorded plots in one process, deterministically and without a network.

    Args:
        scenario: scenario file, or name of one that comes along.
        plots: recorded plots (JSON Lines); default: the scenario's recording, or its simulated world.
        as_json: print one JSON line per track and measurement time, and nothing else.
        lag: with --json, say in each line also where the track was so many seconds ago, with everything known now.
        centralised: let one tracker have all plots, instead of a network: the yardstick for what a network finds.
    """
    from waldnet.launch.checks import warn
    from waldnet.offline.centralised import Centralised
    from waldnet.offline.replay import Replay
    from waldnet.recording.lines import TrackLines
    from waldnet.sensor_node.sources import all_scans, recording_of

    if lag is not None and not as_json:
        raise ConfigError("--lag: the states of tracks are in JSON lines only: give --json too")
    loaded = load_scenario(find(scenario))
    lines = TrackLines(loaded, lag)
    final: dict[int, str] = {}
    scans = all_scans(loaded, plots=plots)
    warn(loaded, scans, recording_of(loaded, plots))
    network = Replay(loaded, scans)
    for message in Centralised.of(loaded).run(scans) if centralised else network.run():
        if isinstance(message, Tracks) and as_json:
            sys.stdout.writelines(line + "\n" for line in lines.of(message))
        elif isinstance(message, Tracks):
            for row, track in enumerate(message.ids):
                status = Status(message.status[row]).name.lower()
                final[int(track)] = f"track {track}: {status}, log LR in total {message.log_lr_total[row]:+.2f}"
        elif not as_json:
            time_s = loaded.to_seconds(message.time_ns)
            print(f"{time_s:8.2f} s  track {message.track} {message.kind}, log LR {message.log_lr:+.2f}")
    if not as_json:
        print("\n".join(text for _, text in sorted(final.items())))
    for what, count in network.left_out.items():
        print(f"{loaded.name}: {count} {what}", file=sys.stderr)


@app.command
def simulate(scenario: str, *, seed: Seed | None = None, out: Path | None = None, truth: Path | None = None) -> None:
    """Write the plots of a simulated world as JSON Lines: those that the processes of ``waldnet run`` will see.

    Args:
        scenario: scenario file, or name of one that comes along.
        seed: of everything random, instead of the scenario's.
        out: file to write; default standard output.
        truth: file to write the targets' true positions to (JSON Lines), for waldnet evaluate.
    """
    from waldnet.scenarios.plots import write_plots
    from waldnet.scenarios.truth import write_truth
    from waldnet.scenarios.world import simulate_all
    from waldnet.scenarios.world import truth as true_states
    from waldnet.sensor_node.sources import seed_of

    loaded = load_scenario(find(scenario))
    seed = seed_of(loaded, seed)
    scans = simulate_all(loaded, seed)
    if truth is not None:
        with replacing_text(truth) as file:
            write_truth(file, *true_states(loaded, seed), loaded)
    with replacing_text(out) if out else nullcontext(sys.stdout) as file:
        write_plots(file, scans, loaded)


@app.command
def check(
    scenario: str,
    plots: Path | None = None,
    *,
    strict: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Validate a scenario file, and its recorded plots and trajectories if it has any, and warn of what does not fit.

    Args:
        scenario: scenario file, or name of one that comes along.
        plots: recorded plots to validate too, instead of the scenario's.
        strict: end with exit code 1 if there is a warning (notes are none).
    """
    from waldnet.evaluation.false_tracks import false_tracks
    from waldnet.launch.checks import describe, findings, read_recording, recording_table
    from waldnet.launch.measuring import describe_false_tracks
    from waldnet.scenarios.trajectories import read_trajectories

    loaded = load_scenario(find(scenario))
    fusion = loaded.fusion
    print(
        f"{loaded.name}: {len(loaded.sensors)} sensors, {len(loaded.hypotheses)} hypotheses, {len(loaded.targets)} "
        f"simulated targets; {fusion.mode}, association {fusion.association}, feedback {fusion.feedback}"
    )
    recording = plots or (loaded.recording.plots if loaded.recording else None)
    scans, found = read_recording(recording, loaded) if recording is not None else ([], [])
    if scans:
        print(f"{recording}: {len(scans)} scans, {sum(len(scan.z) for scan in scans)} plots")
        print("\n".join(recording_table(loaded, scans)))
    if trajectories := read_trajectories(loaded):
        print(f"recorded targets: {len(trajectories)}")
    if (bound := false_tracks(loaded)) is not None:
        print(fill(describe_false_tracks(bound, loaded.decision.p0), 120))
    found += findings(loaded, scans)
    for line in describe(found):
        print(line)
    if strict and any(finding.spoils for finding in found):
        sys.exit(1)


@app.command
def router(
    *,
    listen: Annotated[tuple[str, ...], Parameter(negative=())] = ("tcp/127.0.0.1:7447",),
    health: HealthSocket = None,
    log: LogFormat = "auto",
) -> None:
    """Run a Zenoh router, to which nodes and center connect as clients (--mode client).

    Args:
        listen: endpoint to listen on; may be given several times. tcp/0.0.0.0:7447 is open to all hosts.
        health: local socket at which this process answers how it is (see: python -m waldnet.common.health).
        log: how to log to standard error.
    """
    from waldnet.launch.router import serve

    configure(log)
    serve(Network(mode="router", listen=listen), health)


@app.command
def watch(
    scenario: str,
    *,
    options: NetworkOptions | None = None,
    until_end: Annotated[bool, Parameter(negative=())] = False,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
    verbose: Verbose = False,
    health: HealthSocket = None,
    log: LogFormat = "auto",
) -> None:
    """Print the decisions of a running network, and who comes and goes, until Ctrl-C.

    Times are those of the measurements: the clock in UTC, and seconds since the scenario's epoch.

    Over a router it sees all who come and go; connected to the center itself, the center only.

    Args:
        scenario: scenario file, or name of one that comes along; for the network's name and the epoch of times.
        options: the network.
        until_end: end once all sources are exhausted.
        as_json: print JSON lines, with all decisions.
        verbose: print decisions on tracks that were never confirmed too.
        health: local socket at which this process answers how it is (see: python -m waldnet.common.health).
        log: how to log to standard error.
    """
    from waldnet.launch.watch import watch

    configure(log)
    loaded = load_scenario(find(scenario))
    network = (options or NetworkOptions()).over(loaded)
    watch(loaded, network, until_end=until_end, as_json=as_json, verbose=verbose, health=health)


@app.command
def scenarios() -> None:
    """List the scenarios that come along."""
    for name in names():
        first = find(name).read_text(encoding="utf-8").splitlines()[0]
        print(f"{name:18} {first.lstrip('# ')}")


@app.command
def schema() -> None:
    """Print the JSON Schema of scenario files, for editors."""
    print(json.dumps(Scenario.model_json_schema(by_alias=True), indent=2))


def main() -> None:
    """Entry point of ``waldnet``."""
    warnings.showwarning = _warn
    run_app(app)


def _warn(message: Warning | str, *_where: object, **_place: object) -> None:
    """Say a warning as errors are said: one line."""
    print(f"warning: {message}", file=sys.stderr)
