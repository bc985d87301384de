"""How well sensors do in a recording, measured where targets are known: p_d, false plots, errors, and how they last.

Around every place where a target is expected lie its plot, if it has one, and false plots. Which is which is not known;
what fits all of them best is found by expectation maximisation (docs/how-to/measure.md):

    w_j = p N(u_j; b, C) / (rho (1 - p) + p sum_i N(u_i; b, C)),

u_j the error of plot j in units of the scenario's sigma, within a gate around the expected plot, p the detection
probability, b the bias, C = diag(sigma^2), rho the density of false plots there, uniform in the field of view. Where
the target itself is not known well, C (I + E) stands for C, E its variances. Then p is the mean of sum_j w_j, b and C
are weighted moments, and all other plots are false.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.estimation.association import innovations
from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian, times_transposed
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.messages import IntArray, Scan
from waldnet.scenarios.persistence import Watch, correlation, fitted, watches
from waldnet.scenarios.trajectories import Trajectory

#: Radius of the gate, in units of the scenario's sigma; it is doubled up to so many times where errors reach its edge.
GATE, _DOUBLED = 5.0, 2
#: In view is a target that is so surely.
_SURELY = 0.999
#: A true position is known so well [m].
_EXACT = 1e-3
_STEPS = 200
#: Misses come in rows where the chain of visible and hidden is better than independent misses by so much (log).
_ROWS = 10.0
#: With fewer looks than this nothing is said of how misses and errors last.
_FEW = 30
#: 95 % of a normal distribution lie within so many standard deviations.
_Z = 1.96


class Path(NamedTuple):
    """Where a target is expected during the scans of one sensor.

    Attributes:
        number: of the target or track.
        x: states, shape (K, n); NaN where there is none.
        P: covariances, shape (K, n, n).
    """

    number: int
    x: Array
    P: Array


class Looks(NamedTuple):
    """A sensor's looks at one target, one per scan.

    Attributes:
        there: whether the target was expected at all, shape (K,).
        in_view: whether it was surely in view, shape (K,).
        counted: whether no other target was near it, too, shape (K,).
        errors: of the plot that is assigned to it [units of sigma], shape (K, m); NaN where there is none.
        gated: errors of all plots in its gate [units of sigma], one array (M, m) per scan.
        extra: variances of the expected plot [units of sigma^2], shape (K, m).
        rho: density of false plots at the expected plot [1/unit of sigma^m] if there is one per scan, shape (K,).
    """

    there: BoolArray
    in_view: BoolArray
    counted: BoolArray
    errors: Array
    gated: list[Array]
    extra: Array
    rho: Array

    @property
    def found(self) -> BoolArray:
        """In which scans a plot is assigned to it, shape (K,)."""
        return np.isfinite(self.errors[:, 0])


class Figure(NamedTuple):
    """A measured number and its 95 % confidence interval, for independent scans."""

    value: float
    low: float
    high: float


class SensorFigures(NamedTuple):
    """What was measured of one sensor.

    Attributes:
        name: of the sensor.
        scans: their number.
        looks: at targets that were surely in view and alone.
        near_another: looks that were left out because another target was near.
        p_d: share of looks with a plot of the target; None without looks, as all that follow but false_plots.
        false_plots: per scan; None without scans.
        bias: mean errors of the target's plots, one per number of a plot [m, rad, m/s].
        sigma: standard deviations around the bias.
        visible: p_d while visible, mean times visible and hidden [s]; None: misses do not come in rows.
        errors_last_s: after so long errors, without bias, agree by less than half; None: from scan to scan already.
    """

    name: str
    scans: int
    looks: int
    near_another: int
    p_d: Figure | None
    false_plots: Figure | None
    bias: tuple[Figure, ...]
    sigma: tuple[Figure, ...]
    visible: tuple[float, float, float] | None
    errors_last_s: float | None


class _Fit(NamedTuple):
    """What fits the plots around targets best, errors in units of the scenario's sigma."""

    p_d: float
    bias: Array
    sigma: Array
    per_look: Array


def assign(distances: Array, near: float) -> tuple[IntArray, IntArray]:
    """The pairs of targets and plots that are less than ``near`` apart, each in one pair at most.

    Args:
        distances: shape (targets, plots).
        near: plots that are farther away are no target's.

    Returns:
        rows of targets and of plots; as many pairs as can be, and of these the closest.
    """
    targets, plots = linear_sum_assignment(np.where(distances < near, distances, 1e6 * near))
    close = distances[targets, plots] < near
    return targets[close], plots[close]


def true_paths(trajectories: dict[int, Trajectory], scans: Sequence[Scan], n: int) -> list[Path]:
    """Paths of known targets during the scans of one sensor."""
    times_ns = np.array([scan.time_ns for scan in scans], dtype=np.int64)
    P = np.broadcast_to(_EXACT**2 * np.eye(n), (len(scans), n, n))
    return [Path(number, trajectory.states(times_ns, n), P) for number, trajectory in trajectories.items()]


def look(
    config: SensorConfig, sensor: Sensor, scans: Sequence[Scan], paths: Sequence[Path], gate: float
) -> list[Looks]:
    """Compare the scans of a sensor with where targets are expected.

    Args:
        config: the sensor, as the scenario has it.
        sensor: its model.
        scans: by time, K of them.
        paths: of the targets.
        gate: radius around an expected plot [units of the scenario's sigma].

    Returns:
        the looks at each target, in the order of the paths.
    """
    m, count = sensor.measurement.m, len(scans)
    looks = [
        Looks(
            np.array(np.isfinite(path.x).all(axis=-1)),
            np.zeros(count, np.bool_),
            np.zeros(count, np.bool_),
            np.full((count, m), np.nan),
            [np.empty((0, m))] * count,
            np.zeros((count, m)),
            np.zeros(count),
        )
        for path in paths
    ]
    for k, scan in enumerate(scans):
        rows = [row for row, one in enumerate(looks) if one.there[k]]
        if rows:
            density = Gaussian(np.array([paths[i].x[k] for i in rows]), np.array([paths[i].P[k] for i in rows]))
            _look_once(config, sensor.at(scan.pose), scan, density, [looks[i] for i in rows], k, gate)
    return looks


def _look_once(
    config: SensorConfig, sensor: Sensor, scan: Scan, density: Gaussian, looks: Sequence[Looks], k: int, gate: float
) -> None:
    """Compare one scan with the targets that are there, and note it in their looks."""
    d, sigma = len(scan.position), np.array(config.sigma)
    seen = sensor.measurement.linearise(density, scan.position)
    extra = (seen.H @ times_transposed(density.P, seen.H) + seen.R).diagonal(axis1=-2, axis2=-1) / sigma**2 - 1.0
    extra = np.maximum(extra, 0.0)
    errors = innovations(scan.z[None], seen.z[:, None], seen.angular) / sigma
    distances = np.linalg.vector_norm(errors / np.sqrt(1.0 + extra)[:, None], axis=-1)
    position = Gaussian(density.x[:, :d], density.P[:, :d, :d])
    inside = sensor.field_of_view.probability_inside(position, config.view_center(scan.position)) > _SURELY
    relative = sensor.log_relative(seen.z, scan.position)
    log_rho = sensor.log_rho_f - np.log(config.false_plots) + (np.zeros(len(looks)) if relative is None else relative)
    between = innovations(seen.z[None], seen.z[:, None], seen.angular) / sigma
    others = np.linalg.vector_norm(between / np.sqrt(1.0 + extra)[:, None], axis=-1) + np.diag(
        np.full(len(looks), np.inf)
    )
    for row, one in enumerate(looks):
        one.in_view[k], one.counted[k] = inside[row], inside[row] and others[row].min() > 2.0 * gate
        one.gated[k] = errors[row, distances[row] < gate]
        one.extra[k], one.rho[k] = extra[row], np.exp(log_rho[row]) * np.prod(sigma)
    for row, plot in zip(*assign(distances, gate), strict=True):
        looks[row].errors[k] = errors[row, plot]


def measure_sensor(
    scenario: Scenario, name: str, scans: Sequence[Scan], paths: Sequence[Path], gate: float = GATE
) -> SensorFigures:
    """Measure one sensor.

    Args:
        scenario: what is claimed of it.
        name: of the sensor.
        scans: all of its scans, by time.
        paths: of the targets during these scans.
        gate: radius around an expected plot within which its plot is looked for [units of the scenario's sigma]; where
            errors turn out to reach its edge it is doubled.
    """
    config, sensor = scenario.sensor(name), scenario.sensor(name).build(scenario.motion.build())
    for _ in range(_DOUBLED + 1):
        looks = look(config, sensor, scans, paths, gate)
        fit = _fit(looks, scans)
        if fit is None or (np.abs(fit.bias) + 3.0 * fit.sigma < gate).all():
            break
        gate *= 2.0
    times_s = np.array([scenario.to_seconds(scan.time_ns) for scan in scans])
    return _figures(config, scans, looks, fit, times_s)


def _fit(looks: Sequence[Looks], scans: Sequence[Scan]) -> _Fit | None:
    """Expectation maximisation; None without a plot in any gate."""
    rows = [(one, k) for one in looks for k in np.flatnonzero(one.counted).tolist()]
    owner = np.repeat(np.arange(len(rows)), [len(one.gated[k]) for one, k in rows])
    if not len(owner):
        return None
    u = np.concatenate([one.gated[k] for one, k in rows])
    wider = 1.0 + np.array([one.extra[k] for one, k in rows])[owner]
    rho = np.array([one.rho[k] for one, k in rows])[owner]
    others = sum(len(scan.z) for scan in scans) - sum(int((one.found & ~one.counted).sum()) for one in looks)
    m = u.shape[1]
    p, b, C, w = 0.5, np.zeros(m), np.ones(m), np.zeros(len(u))
    for _ in range(_STEPS):
        false_plots = max(others - float(w.sum()), 0.5) / len(scans)
        S = C * wider
        density = np.exp(-0.5 * (np.square(u - b) / S + np.log(2.0 * np.pi * S)).sum(axis=-1))
        of_look = np.bincount(owner, density, len(rows))[owner]
        w, before = p * density / (false_plots * rho * (1.0 - p) + p * of_look + 1e-300), w
        if not w.sum() > 0.0:
            return None
        p = float(np.clip(w.sum() / len(rows), 1e-6, 1.0 - 1e-9))
        b = w @ u / w.sum()
        C = np.maximum(w @ (np.square(u - b) / wider) / w.sum(), 1e-8)
        if np.abs(w - before).max() < 1e-9:
            break
    return _Fit(p, b, np.sqrt(C), np.bincount(owner, w, len(rows)).astype(np.float64))


def _figures(
    config: SensorConfig, scans: Sequence[Scan], looks: Sequence[Looks], fit: _Fit | None, times_s: Array
) -> SensorFigures:
    counted = int(sum(one.counted.sum() for one in looks))
    near_another = sum(int((one.in_view & ~one.counted).sum()) for one in looks)
    hits = 0.0 if fit is None else float(fit.per_look.sum())
    sigma = np.array(config.sigma)
    return SensorFigures(
        name=config.name,
        scans=len(scans),
        looks=counted,
        near_another=near_another,
        p_d=_share(hits, counted) if counted else None,
        false_plots=_false_plots(scans, looks, fit),
        bias=()
        if fit is None
        else tuple(_mean(b, s, hits) for b, s in zip(fit.bias * sigma, fit.sigma * sigma, strict=True)),
        sigma=() if fit is None else tuple(_spread(s, hits) for s in fit.sigma * sigma),
        visible=None if fit is None else _visible(_watches(looks, fit, times_s)),
        errors_last_s=None if fit is None else _errors_last(_watches(looks, fit, times_s), times_s),
    )


def _false_plots(scans: Sequence[Scan], looks: Sequence[Looks], fit: _Fit | None) -> Figure | None:
    """Plots per scan that are no target's."""
    if not scans:
        return None
    left = np.array([len(scan.z) for scan in scans], dtype=np.float64)
    at = 0
    for one in looks:
        counted = np.flatnonzero(one.counted)
        left -= one.found & ~one.counted
        if fit is not None:
            left[counted] -= fit.per_look[at : at + len(counted)]
            at += len(counted)
    mean = max(float(left.mean()), 0.0)
    # No fewer than what a Poisson distribution would have, so that a quiet sensor is not taken for sure.
    error = float(_Z * np.sqrt(max(float(left.var()), mean) / len(left)))
    return Figure(mean, max(mean - error, 0.0), mean + error + (3.0 / len(left) if mean == 0.0 else 0.0))


def _share(hits: float, looks: int) -> Figure:
    """A probability (Wilson)."""
    p, z2 = hits / looks, _Z**2
    middle, half = p + z2 / (2 * looks), _Z * np.sqrt(max(p * (1 - p), 0.0) / looks + z2 / (4 * looks**2))
    return Figure(
        p, float(max((middle - half) / (1 + z2 / looks), 0.0)), float(min((middle + half) / (1 + z2 / looks), 1.0))
    )


def _mean(bias: float, sigma: float, hits: float) -> Figure:
    error = _Z * sigma / np.sqrt(max(hits, 1.0))
    return Figure(float(bias), float(bias - error), float(bias + error))


def _spread(sigma: float, hits: float) -> Figure:
    share = _Z / np.sqrt(2.0 * max(hits, 1.0))
    return Figure(float(sigma), float(sigma * max(1.0 - share, 0.0)), float(sigma * (1.0 + share)))


def _watches(looks: Sequence[Looks], fit: _Fit, times_s: Array) -> list[Watch]:
    """Stretches of looks at each target, errors without bias, of plots that are rather the target's than false."""
    seen, at = [], 0
    for one in looks:
        counted = np.flatnonzero(one.counted)
        errors = np.full_like(one.errors, np.nan)
        hit = counted[fit.per_look[at : at + len(counted)] > 0.5]
        errors[hit] = one.errors[hit] - fit.bias
        at += len(counted)
        seen += watches(times_s, one.counted, errors)
    return seen


def _visible(seen: Sequence[Watch]) -> tuple[float, float, float] | None:
    """p_d while visible and mean times, where misses come in rows."""
    found = np.concatenate([watch.found for watch in seen]) if seen else np.zeros(0)
    if len(found) < _FEW or not 0 < found.sum() < len(found):
        return None
    persistence = fitted(seen)
    if persistence.gained * len(found) < _ROWS:
        return None
    return persistence.p_d, persistence.visibility.visible_s, persistence.visibility.hidden_s


def _errors_last(seen: Sequence[Watch], times_s: Array) -> float | None:
    """After how long two errors of one target agree by less than half [s]; None: from scan to scan already."""
    if sum(watch.found.sum() for watch in seen) < _FEW:
        return None
    interval, scans = float(np.median(np.diff(times_s))), 1
    if not correlation(seen, interval) > 0.5:
        return None
    while correlation(seen, scans * interval) > 0.5:
        scans += (scans + 1) // 2
    return scans * interval
