"""What a study costs: milliseconds per run and scan of the network, mode by mode, beside the same job in Stone Soup.

    python -m waldnet.benchmarks.modes [--scenario heavy-clutter] [--runs 100] [--soup-runs 3]

Stone Soup's job is that of mode ``centralised``: PDA, sensor after sensor, on the very same plots of the first runs.
That it is the same job is checked: its tracks must be those of the mode. It computes no likelihood ratio.
"""

from __future__ import annotations

import argparse
import datetime
import time

import numpy as np

from waldnet.benchmarks.machine import described
from waldnet.common.config import Scenario, load_scenario
from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.motion import ConstantVelocity
from waldnet.scenarios.catalogue import find
from waldnet.studies.course import Worlds
from waldnet.studies.modes import MODES, play
from waldnet.studies.worlds import draw, studied

PACKAGES = ("waldnet", "numpy", "stonesoup")
#: Stone Soup interleaves position and velocity.
_ORDER = [0, 2, 1, 3]
#: A Cartesian track is the same to so many metres: Stone Soup updates its covariance another way.
_SAME_M = 0.01


def stone_soup(scenario: Scenario, worlds: Worlds, runs: int) -> Array:
    """Mode ``centralised`` in Stone Soup, run after run.

    Args:
        scenario: a 2-D network of position sensors that see everywhere, constant velocity.
        worlds: truth and plots.
        runs: how many of them.

    Returns:
        the tracks after the last scan, shape (runs, 4).
    """
    from stonesoup.dataassociator.probability import PDA
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel
    from stonesoup.models.transition.linear import ConstantVelocity as SoupVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.updater.probability import PDAUpdater

    motion = scenario.motion.build()
    assert isinstance(motion, ConstantVelocity) and motion.dimensions == 2
    sensors = [config.build(motion) for config in scenario.sensors]
    models = [LinearGaussian(4, (0, 2), sensor.measurement.R) for sensor in sensors]
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([SoupVelocity(motion.psd)] * 2))
    associators = [
        PDA(
            PDAHypothesiser(
                predictor,
                PDAUpdater(model),
                clutter_spatial_density=float(np.exp(sensor.log_rho_f)),
                prob_detect=sensor.p_d,
                prob_gate=scenario.fusion.gate_probability,
            )
        )
        for sensor, model in zip(sensors, models, strict=True)
    ]
    updaters = [associator.hypothesiser.updater for associator in associators]
    hypothesis, epoch = scenario.hypotheses[studied(scenario)], datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
    x0, P0 = hypothesis.density
    last = np.empty((runs, 4))
    for run in range(runs):
        begin = epoch + datetime.timedelta(seconds=hypothesis.start)
        track = Track([GaussianState(x0[_ORDER, None], P0[np.ix_(_ORDER, _ORDER)], timestamp=begin)])
        for look in worlds.looks:
            now = epoch + datetime.timedelta(seconds=scenario.to_seconds(look.time_ns))
            z = look.plots.z[run] if look.plots.valid is None else look.plots.z[run][look.plots.valid[run]]
            model = models[look.sensor]
            plots = {Detection(plot[:, None], timestamp=now, measurement_model=model) for plot in z}
            hypotheses = associators[look.sensor].associate({track}, plots, now)
            track.append(updaters[look.sensor].update(hypotheses[track]))
        last[run, _ORDER] = np.asarray(track.state_vector, dtype=np.float64).ravel()
    return last


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="heavy-clutter")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--soup-runs", type=int, default=3)
    arguments = parser.parse_args()
    scenario = load_scenario(find(arguments.scenario))
    began = time.perf_counter()
    worlds = draw(scenario, np.arange(arguments.runs))
    per_scan = 1e3 / (len(worlds.times_ns) * arguments.runs)
    rows = [("(drawing the worlds)", (time.perf_counter() - began) * per_scan)]
    centralised = None
    for mode in MODES:
        began = time.perf_counter()
        course = play(scenario, mode, worlds)
        rows.append((mode, (time.perf_counter() - began) * per_scan))
        centralised = course if mode == "centralised" else centralised
    began = time.perf_counter()
    theirs = stone_soup(scenario, worlds, arguments.soup_runs)
    soup = (time.perf_counter() - began) * 1e3 / (len(worlds.times_ns) * arguments.soup_runs)
    assert centralised is not None
    difference = np.abs(theirs[:, :2] - centralised.x[: arguments.soup_runs, -1, :2]).max()
    if not difference < _SAME_M:
        raise SystemExit(f"not the same job: tracks differ by {difference:.3g} m")
    print(described(*PACKAGES))
    sensors, plots = len(scenario.sensors), np.mean([look.counts.mean() for look in worlds.looks])
    print(f"\n{scenario.name}: {sensors} sensors, {plots:.0f} plots a scan, {arguments.runs} runs at once")
    print("milliseconds per run and scan of the network\n")
    print("| mode | ms | Stone Soup's centralised PDA / this |")
    print("|---|---:|---:|")
    for mode, cost in rows:
        print(f"| {mode} | {cost:.3f} | {soup / cost:.0f} |")
    print(f"| Stone Soup, centralised PDA, {arguments.soup_runs} runs | {soup:.1f} | 1 |")


if __name__ == "__main__":
    main()
