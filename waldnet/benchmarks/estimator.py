"""Speed of the estimator: PDAF and LR per track and scan, beside Stone Soup's PDA in the same run.

    python waldnet/benchmarks/estimator.py [--json FILE]

One scan of 6 plots, 2-D, for batches of 1 to 1000 tracks: prediction, gate, PDAF update and log p_bar added up
(Eq. 5-7); the same with tight association (Eq. 12, 13); and the center's step for 4 sensors (Eq. 8-10, 14). Stone Soup
does prediction, PDA and update of one track at a time. Figures are medians over repetitions, in microseconds per track
and scan; machines differ and are noisy: the ratio travels, the microseconds do not.
"""

from __future__ import annotations

import argparse
import datetime
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from waldnet.benchmarks.machine import machine
from waldnet.common.estimation.association import Clutter, Plots, expect, pdaf, update
from waldnet.common.estimation.field_of_view import Everywhere
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.motion import ConstantVelocity
from waldnet.common.estimation.representation import Share
from waldnet.common.estimation.sensing import Position, Sensor
from waldnet.common.estimation.sprt import thresholds
from waldnet.common.messages import NEVER, Report
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.factors import Fuser, Heard
from waldnet.fusion_center.life import Life

PACKAGES = ("numpy", "scipy", "stonesoup")
BATCHES = (1, 10, 100, 1000)
PLOTS, SENSORS = 6, 4
P_D, RHO_F, P_G = 0.9, 5.0 / 40_000.0**2, 0.9997
SIGMA, PSD, DT = 50.0, 10.0, 2.0
PRIOR = np.diag([1e4, 1e4, 400.0, 400.0])
MOTION, SENSOR = ConstantVelocity(2, PSD), Position((SIGMA, SIGMA), 4)


def microseconds(work: Callable[[], object], repetitions: int = 15, least_s: float = 0.02) -> float:
    """Median time of one call."""
    work()
    start = time.perf_counter()
    work()
    calls = max(1, round(least_s / max(time.perf_counter() - start, 1e-9)))
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        for _ in range(calls):
            work()
        times.append((time.perf_counter() - start) / calls)
    return 1e6 * statistics.median(times)


def world(tracks: int) -> tuple[Gaussian, Array]:
    """Tracks with one plot near each and five around it."""
    rng = np.random.default_rng(1)
    x = np.concatenate([rng.uniform(-2e4, 2e4, (tracks, 2)), rng.normal(0.0, 100.0, (tracks, 2))], axis=-1)
    ahead = x[:, None, :2] + DT * x[:, None, 2:]
    z = ahead + rng.normal(0.0, 120.0, (tracks, PLOTS, 2))
    return Gaussian(x, np.repeat(PRIOR[None], tracks, axis=0)), z


def waldnet_scan(tracks: int, *, tightly: bool) -> Callable[[], object]:
    """A node's work for one scan."""
    prior, z = world(tracks)
    plots = Plots(z, np.ones(z.shape[:-1], np.bool_))
    clutter = Clutter(np.full(tracks, P_D), np.array(np.log(RHO_F)), P_G)
    log_p_bar, dt, origin = np.zeros(tracks), np.array(DT), np.zeros(2)
    share, honest = Share(SENSORS), Share(1.0)
    factor = share.start(prior)

    def scan() -> object:
        predicted = share.predict(factor, MOTION, dt)
        if not tightly:
            filtered = pdaf(predicted, plots, SENSOR.linearise(predicted, origin), clutter)
            return log_p_bar + filtered.log_p_bar
        pairs = zip(predicted, honest.predict(prior, MOTION, dt), strict=True)
        both = Gaussian(*(np.stack(pair) for pair in pairs))
        filtered = update(expect(both, SENSOR.linearise(both, origin), clutter), plots)
        return log_p_bar + filtered.log_p_bar

    return scan


def center_scan(tracks: int) -> Callable[[], object]:
    """The center's work for one measurement time: predict all factors, both constants, LR, decision, fused tracks."""
    prior, _ = world(tracks)
    ids, now = np.arange(tracks), np.zeros(tracks, np.int64)
    sensor = Sensor(SENSOR, P_D, 5.0, Everywhere(5.0 / RHO_F, 2))
    fuser = Fuser(MOTION, (sensor,) * SENSORS, Share(SENSORS), 1, np.inf, globalised=False)
    life = Life(thresholds(1e-4, 0.95), None, (), 2, np.inf)
    picture = fuser.begin(fuser.empty(), ids, now, prior)
    x, P, log_g = prior.x + 10.0, 0.5 * SENSORS * prior.P, np.ones(tracks)
    later = round(DT * NS_PER_S)
    report = Report("", 0, later, NEVER, 1, ids, np.ones_like(ids), log_g, x, P)
    reports = {number: Heard.of(report) for number in range(SENSORS)}
    return lambda: life.judge(fuser.advance(fuser.expect(picture, later), reports), later, ())


def stone_soup_scan() -> Callable[[], object]:
    """Stone Soup's PDA of one track: predict, hypothesise, associate, update."""
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

    prior, z = world(1)
    order = [0, 2, 1, 3]  # Stone Soup interleaves position and velocity
    start = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
    then = start + datetime.timedelta(seconds=DT)
    state = GaussianState(prior.x[0][order, None], prior.P[0][np.ix_(order, order)], timestamp=start)
    measurement = LinearGaussian(4, (0, 2), np.diag([SIGMA**2, SIGMA**2]))
    motion = CombinedLinearGaussianTransitionModel([SoupVelocity(PSD), SoupVelocity(PSD)])
    updater = PDAUpdater(measurement)
    hypothesiser = PDAHypothesiser(KalmanPredictor(motion), updater, RHO_F, prob_detect=P_D, prob_gate=P_G)
    associator = PDA(hypothesiser)
    track = Track([state])
    detections = {Detection(plot[:, None], timestamp=then, measurement_model=measurement) for plot in z[0]}

    def scan() -> object:
        hypotheses = associator.associate({track}, detections, then)
        return updater.update(hypotheses[track])

    return scan


def measure() -> dict[str, Any]:
    """All figures."""
    soup_scan = stone_soup_scan()
    rows = []
    for tracks in BATCHES:
        # Just before, not once for all: the speed of a shared machine drifts.
        soup = microseconds(soup_scan)
        factor = microseconds(waldnet_scan(tracks, tightly=False)) / tracks
        both = microseconds(waldnet_scan(tracks, tightly=True)) / tracks
        center = microseconds(center_scan(tracks)) / tracks
        rows.append(
            {
                "tracks": tracks,
                "pdaf_us": round(factor, 2),
                "tight_us": round(both, 2),
                "center_us": round(center, 2),
                "stone_soup_pda_us": round(soup, 1),
                "stone_soup_over_pdaf": round(soup / factor, 1),
            }
        )
    return {"machine": machine(*PACKAGES), "plots": PLOTS, "sensors": SENSORS, "rows": rows}


def main() -> None:
    """Print a table, and write JSON if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    arguments = parser.parse_args()
    result = measure()
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")
    print(", ".join(f"{key} {value}" for key, value in result["machine"].items()))
    print("\nmicroseconds per track and scan, medians")
    print("| tracks | PDAF + LR | tight + LR | center, 4 sensors | Stone Soup PDA | ratio |")
    print("|---:|---:|---:|---:|---:|---:|")
    for row in result["rows"]:
        print(
            f"| {row['tracks']} | {row['pdaf_us']} | {row['tight_us']} | {row['center_us']} "
            f"| {row['stone_soup_pda_us']} | {row['stone_soup_over_pdaf']} |"
        )


if __name__ == "__main__":
    main()
