"""``waldnet measure``: what a recording says of its sensors, beside what the scenario claims of them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from waldnet.common.config import Scenario, SensorConfig, load_scenario
from waldnet.common.errors import ConfigError
from waldnet.common.messages import Scan
from waldnet.evaluation.false_tracks import FalseTracks, false_tracks
from waldnet.scenarios.measure import Figure, SensorFigures, measure_sensor, true_paths

_WIDTH = 120
#: What is not measured where nobody knows the targets.
_OF_TRACKS = (
    "Targets are the confirmed tracks of a centralised run. A target that was never confirmed is not counted, and its "
    "plots pass for false ones; clutter that was confirmed passes for a target. So p_d tends to be too high. Errors "
    "that stay the same for long go into the tracks: sigma is too small then, bias what sensors do not share."
)


def measure(
    scenario: str,
    plots: Path | None = None,
    *,
    truth: Path | None = None,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Measure what a recording says of its sensors: p_d, false plots, bias and sigma, and how misses and errors last.

    Args:
        scenario: scenario file, or name of one that comes along: what it claims stands beside what is measured.
        plots: recorded plots (JSON Lines); default: the scenario's recording, or its simulated world.
        truth: file of true positions (JSON Lines); without it the confirmed tracks of a centralised run are targets.
        as_json: print one JSON object, and nothing else.
    """
    from waldnet.scenarios.catalogue import find
    from waldnet.scenarios.plots import read_plots
    from waldnet.scenarios.world import simulate_all
    from waldnet.sensor_node.sources import recording_of, seed_of

    loaded = load_scenario(find(scenario))
    recording = recording_of(loaded, plots)
    scans = read_plots(recording, loaded) if recording else simulate_all(loaded, seed_of(loaded, None))
    figures = measured(loaded, scans, truth)
    bound = false_tracks(loaded, _intervals(loaded, scans))
    if as_json:
        print(json.dumps(_entry(loaded, figures, bound, truth), allow_nan=False))
    else:
        print("\n".join(_lines(loaded, figures, bound, truth)))


def measured(scenario: Scenario, scans: Sequence[Scan], truth: Path | None) -> list[SensorFigures]:
    """Measure all sensors of a scenario.

    Args:
        scenario: what is claimed of them.
        scans: all of them, by time.
        truth: file of true positions; None: the confirmed tracks of a centralised run are the targets.

    Raises:
        TruthError: when the file is wrong.
        ConfigError: when there are neither tracks nor true positions.
    """
    from waldnet.evaluation.track_paths import track_paths
    from waldnet.scenarios.trajectories import trajectories_of
    from waldnet.sensor_node.sources import spaced

    own = {name: [scan for scan in scans if scan.sensor == name] for name in scenario.sensor_names}
    if truth is not None:
        known, n = trajectories_of(truth, scenario), scenario.motion.build().n
        paths = {name: true_paths(known, seen, n) for name, seen in own.items()}
    elif not scenario.hypotheses and scenario.initiation is None:
        raise ConfigError(f"{scenario.name}: has no hypotheses and no [initiation], so no tracks: give --truth")
    else:
        paths = track_paths(scenario, spaced(scans, scenario), own)
    return [measure_sensor(scenario, name, seen, paths[name]) for name, seen in own.items()]


def _intervals(scenario: Scenario, scans: Sequence[Scan]) -> dict[str, float]:
    """Median times between the scans that are used, by sensor."""
    from waldnet.sensor_node.sources import spaced

    times: dict[str, list[float]] = {}
    for scan in spaced(scans, scenario):
        times.setdefault(scan.sensor, []).append(scenario.to_seconds(scan.time_ns))
    return {name: float(np.median(np.diff(own))) for name, own in times.items() if len(own) > 1}


def suggested(figures: SensorFigures, config: SensorConfig) -> dict[str, Any]:
    """Keys of a ``[[sensor]]`` table that say what was measured; those that nothing is known of are left out."""
    keys: dict[str, Any] = {}
    if figures.visible is not None:
        p_d, visible_s, hidden_s = figures.visible
        keys["p_d"] = _round_probability(min(p_d, 0.999))
        keys["visibility"] = {"visible_for": _round(visible_s), "hidden_for": _round(hidden_s)}
    elif figures.p_d is not None and config.detection.model != "swerling":
        # After a hundred hits of a hundred a miss is possible still.
        keys["p_d"] = _round_probability((figures.p_d.value * figures.looks + 1.0) / (figures.looks + 2.0))
    if figures.sigma:
        keys["sigma"] = [_round(np.hypot(b.value, s.value)) for b, s in zip(figures.bias, figures.sigma, strict=True)]
    if figures.false_plots is not None:
        keys["false_plots"] = _round(max(figures.false_plots.value, 0.5 / figures.scans))
    return keys


def _round(value: float) -> float:
    return float(f"{value:.2g}")


def _round_probability(p: float) -> float:
    """Two digits of what is missing to 1, too: 0.984 is not 0.98."""
    return 1.0 - _round(1.0 - p) if p > 0.9 else _round(p)


def describe_false_tracks(bound: FalseTracks, p0: float) -> str:
    """A sentence on false tracks per day."""
    one = "" if bound.p0_for_one is None else f" p0 = {bound.p0_for_one:.2g} makes it one a day at most."
    return (
        f"False plots start up to {bound.started:.3g} tracks a day; with p0 = {p0:g} at most {bound.confirmed:.3g} of "
        f"them are confirmed.{one}"
    )


def _lines(
    scenario: Scenario, figures: Sequence[SensorFigures], bound: FalseTracks | None, truth: Path | None
) -> Iterator[str]:
    for one, config in zip(figures, scenario.sensors, strict=True):
        near = f", {one.near_another} more with another target near are left out" if one.near_another else ""
        yield f"{one.name}: {one.scans} scans, {one.looks} looks at targets in view{near}"
        rows = [("", "measured", "95 %", "scenario"), *_rows(one, config)]
        widths = [max(len(row[i]) for row in rows) for i in range(4)]
        for row in rows:
            cells = (cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))
            yield "  ".join(["", row[0].ljust(widths[0]), *cells]).rstrip()
        keys = ", ".join(f"{key} = {_toml(value)}" for key, value in suggested(one, config).items())
        yield from wrap(f"  suggested: {keys}" if keys else "  nothing to suggest", _WIDTH, subsequent_indent="    ")
        yield ""
    yield "* the scenario's value lies outside the interval, which holds for independent scans."
    if truth is None:
        yield from wrap(_OF_TRACKS, _WIDTH)
    if bound is not None:
        yield from wrap(describe_false_tracks(bound, scenario.decision.p0), _WIDTH)


def _rows(one: SensorFigures, config: SensorConfig) -> Iterator[tuple[str, str, str, str]]:
    if one.p_d is not None:
        yield _row("p_d", one.p_d, _claimed_p_d(config))
    if one.false_plots is not None:
        yield _row("false plots per scan", one.false_plots, config.false_plots)
    for name, bias, sigma, claimed in zip(config.numbers, one.bias, one.sigma, config.sigma, strict=False):
        yield _row(f"bias of {name}", bias, 0.0)
        yield _row(f"sigma of {name}", sigma, claimed)
    claimed_view = config.visibility
    if one.visible is not None:
        words = ("p_d while visible", "visible for s", "hidden for s")
        claims = (config.p_d, claimed_view.visible_for, claimed_view.hidden_for) if claimed_view else (None,) * 3
        for word, value, claim in zip(words, one.visible, claims, strict=True):
            yield word, f"{value:.3g}", "", "-" if claim is None else f"{claim:g}"
    if one.errors_last_s is not None:
        yield "errors last s", f"{one.errors_last_s:.3g}", "", f"{config.spacing:g}"


def _claimed_p_d(config: SensorConfig) -> float | None:
    """The share of looks that hit, as the scenario has it."""
    share = 1.0 if config.visibility is None else config.visibility.build().share
    return None if config.p_d is None else config.p_d * share


def _row(name: str, figure: Figure, claimed: float | None) -> tuple[str, str, str, str]:
    outside = claimed is not None and not figure.low <= claimed <= figure.high
    claim = "-" if claimed is None else f"{claimed:.3g}{' *' if outside else '  '}"
    return name, f"{figure.value:.3g}", f"{figure.low:.3g} to {figure.high:.3g}", claim


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(inner)}" for key, inner in value.items()) + " }"
    return "[" + ", ".join(map(_toml, value)) + "]" if isinstance(value, list) else f"{value:g}"


def _entry(
    scenario: Scenario, figures: Sequence[SensorFigures], bound: FalseTracks | None, truth: Path | None
) -> dict[str, Any]:
    sensors = [
        {
            **_plain(one),
            "claimed": config.model_dump(mode="json", include={"p_d", "sigma", "false_plots", "visibility", "spacing"}),
            "suggested": suggested(one, config),
        }
        for one, config in zip(figures, scenario.sensors, strict=True)
    ]
    return {
        "scenario": scenario.name,
        "truth": None if truth is None else str(truth),
        "sensors": sensors,
        "false_tracks_per_day": None if bound is None else bound._asdict(),
    }


def _plain(value: Any) -> Any:
    """Named tuples as objects, in depth."""
    if hasattr(value, "_asdict"):
        return {key: _plain(inner) for key, inner in value._asdict().items()}
    return [_plain(inner) for inner in value] if isinstance(value, tuple) else value
