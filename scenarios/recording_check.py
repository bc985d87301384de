"""Whether recorded scans are what a scenario expects: times, intervals, units, axes, empty and repeated scans.

All functions are pure: scans and scenario in, summaries and findings out. A finding is a sentence about a class of
mistakes; what a correct recording can contain by chance gives none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.estimation.association import innovations
from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian, log_pdf, times_transposed
from waldnet.common.estimation.initiation import from_plots
from waldnet.common.estimation.sector import Sector
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.messages import Scan
from waldnet.scenarios.scenario_check import Finding, hypotheses_at

_YEAR_S = 365.25 * 86_400.0
#: A plot whose place lies inside with less than this probability, its noise considered, is outside.
_OUTSIDE = 1e-3
#: So many plots are looked at, spread over the recording.
_SAMPLE = 5000
#: So many scans after the start of a hypothesis are compared with it.
_FIRST_SCANS = 10
#: So many other sensors are compared with each.
_OTHERS = 5
#: With fewer scans than this nothing is said of intervals and counts.
_FEW = 5


class SensorSummary(NamedTuple):
    """A sensor's part of a recording.

    Attributes:
        name: of the sensor.
        scans: their number; without any, all that follows is NaN.
        plots: their number.
        first_s: time of the first scan, since the epoch.
        last_s: time of the last scan.
        interval_s: median time between scans.
        plots_per_scan: mean.
        empty: share of scans without plots.
        outside: share of plots outside the field of view.
        repeated: share of scans, of those with plots, that repeat the plots of the scan before.
    """

    name: str
    scans: int
    plots: int
    first_s: float
    last_s: float
    interval_s: float
    plots_per_scan: float
    empty: float
    outside: float
    repeated: float


class _Recorded(NamedTuple):
    """The scans of one sensor, by time, and what is expected of them."""

    config: SensorConfig
    sensor: Sensor
    dimensions: int
    n: int
    times_s: Array
    scans: tuple[Scan, ...]

    @property
    def where(self) -> str:
        return f"sensor {self.config.name}"

    @property
    def intervals_s(self) -> Array:
        return np.diff(self.times_s)

    @property
    def extent(self) -> float:
        """Side of a square or cube as large as the field of view [m]."""
        return float(self.sensor.field_of_view.volume ** (1.0 / self.dimensions))


def summarise(scenario: Scenario, scans: Sequence[Scan]) -> list[SensorSummary]:
    """What a recording has of each sensor of a scenario, in the order of the scenario.

    Args:
        scenario: names the sensors and their fields of view.
        scans: by time.
    """
    return [_summary(one) for one in _by_sensor(scenario, scans)]


def recording_findings(scenario: Scenario, scans: Sequence[Scan]) -> list[Finding]:
    """What does not fit between a recording and its scenario, what spoils results first.

    Args:
        scenario: the scenario.
        scans: those that are used, by time: without those that ``spacing`` passes over.
    """
    every = _by_sensor(scenario, scans)
    recorded = [one for one in every if one.scans]
    findings = [
        Finding(
            one.where, "has no scan in the recording: it is as if it were switched off. Check its name in the file."
        )
        for one in every
        if not one.scans
    ]
    findings += [*_epoch(scenario, recorded), *_apart_in_time(recorded), *_starts(scenario, recorded)]
    for one in recorded:
        # Repeated scans have intervals and gaps of their own.
        findings += list(_repeats(one)) or list(_intervals(scenario, one))
        findings += [*_counts(scenario, one), *_places(one)]
    findings += [*_copies(recorded), *_against_hypotheses(scenario, recorded), *_between_sensors(scenario, recorded)]
    return sorted(findings, key=lambda finding: not finding.spoils)


def _by_sensor(scenario: Scenario, scans: Sequence[Scan]) -> list[_Recorded]:
    motion = scenario.motion.build()
    own: dict[str, list[Scan]] = {name: [] for name in scenario.sensor_names}
    for scan in scans:
        own[scan.sensor].append(scan)
    return [
        _Recorded(
            config,
            config.build(motion),
            motion.dimensions,
            motion.n,
            np.array([scenario.to_seconds(scan.time_ns) for scan in own[config.name]]),
            tuple(own[config.name]),
        )
        for config in scenario.sensors
    ]


def _summary(one: _Recorded) -> SensorSummary:
    counts, nan = np.array([len(scan.z) for scan in one.scans]), float("nan")
    if not one.scans:
        return SensorSummary(one.config.name, 0, 0, *[nan] * 7)
    outside, repeats, full = _outside(one, _Plots.of(one).sample), _repeated(one), int((counts > 0).sum())
    return SensorSummary(
        name=one.config.name,
        scans=len(one.scans),
        plots=int(counts.sum()),
        first_s=float(one.times_s[0]),
        last_s=float(one.times_s[-1]),
        interval_s=float(np.median(one.intervals_s)) if len(counts) > 1 else nan,
        plots_per_scan=float(counts.mean()),
        empty=float((counts == 0).mean()),
        outside=float(outside.mean()) if len(outside) else nan,
        repeated=len(repeats) / full if full else nan,
    )


# Times ----------------------------------------------------------------------------------------------------------------


def _epoch(scenario: Scenario, recorded: Sequence[_Recorded]) -> Iterator[Finding]:
    far = [one for one in recorded if abs(one.times_s[0]) > _YEAR_S]
    if far:
        years = abs(far[0].times_s[0]) / _YEAR_S
        yield Finding(
            f"time of {', '.join(one.config.name for one in far)}",
            f"the first scan is at {far[0].times_s[0]:.10g} s, {years:.3g} years from the scenario's epoch "
            f"({scenario.epoch.isoformat()}). Times are seconds since the epoch. If these are Unix times, write "
            "epoch = 1970-01-01T00:00:00Z and let the hypotheses start at Unix times too, or subtract the epoch.",
        )


def _apart_in_time(recorded: Sequence[_Recorded]) -> Iterator[Finding]:
    """Sensors whose scans are all before, or all after, those of every other."""
    for one in recorded:
        others = [other for other in recorded if other is not one]
        slack = 10.0 * float(np.median(one.intervals_s)) if len(one.scans) > 1 else 0.0
        first, last = one.times_s[0] - slack, one.times_s[-1] + slack
        if others and all(other.times_s[-1] < first or other.times_s[0] > last for other in others):
            yield Finding(
                one.where,
                f"its scans, {one.times_s[0]:.10g} s to {one.times_s[-1]:.10g} s, have no time in common with those of "
                f"any other sensor ({others[0].config.name}: {others[0].times_s[0]:.10g} s to "
                f"{others[0].times_s[-1]:.10g} s). Expected is one clock, in seconds, for all sensors.",
            )


def _starts(scenario: Scenario, recorded: Sequence[_Recorded]) -> Iterator[Finding]:
    """Hypotheses that start after the last scan, or so long before the first that nothing is known of them by then."""
    if not (scenario.hypotheses and recorded):
        return
    first, last = min(one.times_s[0] for one in recorded), max(one.times_s[-1] for one in recorded)
    starts = np.array([hypothesis.start for hypothesis in scenario.hypotheses])
    if late := np.flatnonzero(starts > last).tolist():
        yield Finding(
            _numbered(late),
            f"starts at {starts[late[0]]:.10g} s, after the last scan at {last:.10g} s, and is never tested. Times are "
            "seconds since the scenario's epoch.",
        )
    d = scenario.motion.dimensions
    then = hypotheses_at(scenario, np.full(len(starts), first)).P.diagonal(axis1=-2, axis2=-1)[:, :d].max(axis=-1)
    sigmas = np.array([max(hypothesis.sigma[:d]) for hypothesis in scenario.hypotheses])
    scan_s = max([float(np.median(one.intervals_s)) for one in recorded if len(one.scans) > 1], default=0.0)
    vague = (np.sqrt(then) > 10.0 * sigmas) & (first - starts > 5.0 * scan_s)
    if early := np.flatnonzero(vague).tolist():
        yield Finding(
            _numbered(early),
            f"starts {first - starts[early[0]]:.10g} s before the first scan, by when its position is known to "
            f"{np.sqrt(then[early[0]]):.3g} m only (at its start: {sigmas[early[0]]:g} m). Let it start with the "
            "recording; times are seconds since the scenario's epoch.",
        )


def _numbered(rows: Sequence[int]) -> str:
    more = f" and {len(rows) - 5} more" if len(rows) > 5 else ""
    return ", ".join(f"hypothesis.{row}" for row in rows[:5]) + more


def _intervals(scenario: Scenario, one: _Recorded) -> Iterator[Finding]:
    if len(one.scans) < _FEW:
        return
    median, claimed = float(np.median(one.intervals_s)), one.config.scan_interval
    speed, set_by_user = _speed(scenario), "scan_interval" in one.config.model_fields_set
    if (missing := _left_out(one)) is not None:
        yield missing
    elif set_by_user and one.config.spacing <= claimed and not 1 / 1.5 < median / claimed < 1.5:
        milli = 300.0 < median / claimed < 3000.0
        unit = "Are these milliseconds? Times are in seconds." if milli else ""
        yield Finding(
            one.where,
            f"the median time between scans is {median:.4g} s, but scan_interval = {claimed:g}. "
            + (unit or f"If the recording is right, write scan_interval = {median:.3g}."),
            spoils=milli,
        )
    if speed is not None and np.isfinite(one.extent) and speed * median > one.extent:
        yield Finding(
            one.where,
            f"between two scans ({median:.4g} s) a target of {speed:.3g} m/s goes {speed * median:.3g} m, farther than "
            f"the field of view is wide ({one.extent:.3g} m): no track can be held. Are times in milliseconds, or "
            "lengths in kilometres? Expected are seconds and metres.",
        )


def _speed(scenario: Scenario) -> float | None:
    """How fast targets are expected to be [m/s], if the scenario says so."""
    if scenario.initiation is not None:
        return scenario.initiation.speed
    d = scenario.motion.dimensions
    moving = [np.square([*h.state[d : 2 * d], *h.sigma[d : 2 * d]]).sum() for h in scenario.hypotheses]
    return float(np.sqrt(np.median(moving))) if moving else None


def _left_out(one: _Recorded) -> Finding | None:
    """Scans that are missing where empty ones should be: no scan is empty, and between them are gaps of whole scans."""
    counts, intervals = np.array([len(scan.z) for scan in one.scans]), one.intervals_s
    if counts.min() != 1 or one.config.spacing > 0.0:
        return None
    base = float(np.quantile(intervals, 0.05))
    if np.std(intervals) > 0.3 * np.mean(intervals):
        base = min(base, one.config.scan_interval)
    missing = int(np.maximum(np.round(intervals / base) - 1.0, 0.0).sum())
    share = missing / (missing + len(counts))
    if missing < 3 or share < 0.05:
        return None
    return Finding(
        one.where,
        f"no scan is empty, the smallest have one plot, and between them about {missing} scans of {base:.3g} s are "
        f'missing ({share:.0%}). If the sensor scanned then and found nothing, write these scans with "plots": []: '
        "without them every miss is lost, and the evidence for each track is too large.",
    )


# Counts ---------------------------------------------------------------------------------------------------------------


def _counts(scenario: Scenario, one: _Recorded) -> Iterator[Finding]:
    counts, false = np.array([len(scan.z) for scan in one.scans]), one.config.false_plots
    if len(counts) < _FEW:
        return
    mean, p_d, targets = float(counts.mean()), one.config.p_d or 1.0, len(scenario.hypotheses)
    if mean < 0.5 * false and false * len(counts) > 20.0:
        yield Finding(
            one.where,
            f"{mean:.3g} plots per scan, those of targets included, but false_plots = {false:g} alone: evidence is "
            "weaker than it could be. waldnet measure tells both apart.",
            spoils=False,
        )
    most = 3.0 * (false + p_d * targets) + 1.0
    if scenario.initiation is None and mean > most and len(counts) >= 10:
        yield Finding(
            one.where,
            f"{mean:.3g} plots per scan, but expected are {false:g} false ones and at most {p_d:g} of each of "
            f"{targets} hypotheses. With false_plots too small, false plots pass for targets: "
            "measure it with waldnet measure.",
        )


def _repeated(one: _Recorded) -> list[int]:
    """Rows of the scans that have the plots of the scan before, to the last digit."""
    return [
        k
        for k in range(1, len(one.scans))
        if len(one.scans[k].z) and np.array_equal(one.scans[k].z, one.scans[k - 1].z)
    ]


def _repeats(one: _Recorded) -> Iterator[Finding]:
    rows, full = _repeated(one), sum(len(scan.z) > 0 for scan in one.scans)
    if len(rows) < 3 or len(rows) < 0.05 * full:
        return
    every = _between_payloads(one, rows)
    advice = f"set spacing = {every:.3g}" if every > 0.0 else "read the sensor less often"
    yield Finding(
        one.where,
        f"{len(rows)} of {full} scans with plots repeat the plots of the scan before to the last digit, under a new "
        "time. One look counts as evidence several times, and false plots are confirmed as targets. Leave repeated "
        f"scans out of the recording, or {advice}.",
    )


def _between_payloads(one: _Recorded, repeated: Sequence[int]) -> float:
    """How long the sensor takes for new plots, rounded down to three digits [s]; NaN if that cannot be told."""
    again = set(repeated)
    firsts = [k - 1 for k in repeated if k - 1 not in again]
    nexts = [next((j for j in range(k + 2, len(one.scans)) if j not in again), None) for k in firsts]
    spans = [float(one.times_s[j] - one.times_s[k]) for k, j in zip(firsts, nexts, strict=True) if j is not None]
    if not spans:
        return float("nan")
    every = float(np.median(spans))
    digit = 10.0 ** (np.floor(np.log10(every)) - 2.0)
    return float(np.floor(every / digit) * digit)


def _copies(recorded: Sequence[_Recorded]) -> Iterator[Finding]:
    """Sensors that have the plots of another one."""
    seen = [{scan.z.tobytes() for scan in one.scans if scan.z.size} for one in recorded]
    for i, one in enumerate(recorded):
        for j, other in enumerate(recorded[:i]):
            full = sum(scan.z.size > 0 for scan in one.scans)
            same = sum(scan.z.tobytes() in seen[j] for scan in one.scans if scan.z.size)
            if one.config.kind == other.config.kind and same >= 3 and same >= 0.05 * full:
                yield Finding(
                    one.where,
                    f"{same} of {full} scans with plots are those of {other.config.name} to the last digit: one look "
                    "counts as evidence of two sensors. Each scan belongs to one sensor.",
                )


# Places ---------------------------------------------------------------------------------------------------------------


class _Plots(NamedTuple):
    """Plots of one sensor, those of all scans one after the other.

    Attributes:
        z: shape (M, m).
        stands: where the sensor stood [m], shape (M, d).
        headings: of its platform [rad], shape (M,).
        times_s: shape (M,).
    """

    z: Array
    stands: Array
    headings: Array
    times_s: Array

    @classmethod
    def of(cls, one: _Recorded) -> _Plots:
        """All plots of a sensor."""
        counts = np.array([len(scan.z) for scan in one.scans])
        return cls(
            np.concatenate([scan.z for scan in one.scans]),
            np.repeat(np.array([scan.position for scan in one.scans]), counts, axis=0),
            np.repeat(np.array([scan.heading for scan in one.scans]), counts),
            np.repeat(one.times_s, counts),
        )

    def rows(self, chosen: Array | slice) -> _Plots:
        """Some of the plots."""
        return _Plots(*(column[chosen] for column in self))

    @property
    def sample(self) -> _Plots:
        """Some plots, spread over the recording."""
        return self.rows(np.unique(np.linspace(0, len(self.z) - 1, min(_SAMPLE, len(self.z))).astype(int)))


def _outside(one: _Recorded, plots: _Plots) -> BoolArray:
    """Which plots lie outside the field of view, their noise considered, shape (M,)."""
    if not len(plots.z):
        return np.zeros(0, np.bool_)
    if not one.config.locates:
        return _outside_directions(one, plots)
    view, offsets, origin = one.sensor.field_of_view, _offsets(one, plots), np.zeros(one.dimensions)
    turns = _turns(one, plots)
    outside = np.array(~view.contains(np.matvec(turns, offsets), origin))
    for k in np.flatnonzero(outside).tolist():
        P = turns[k] @ _covariance(one, plots, k) @ turns[k].T
        density = Gaussian((turns[k] @ offsets[k])[None], P[None])
        outside[k] = view.probability_inside(density, origin)[0] < _OUTSIDE
    return outside


def _outside_directions(one: _Recorded, plots: _Plots) -> BoolArray:
    view = one.sensor.field_of_view
    if not isinstance(view, Sector):
        return np.zeros(len(plots.z), np.bool_)
    near, origin = view._replace(radius=2.0, inner=0.0), np.zeros(one.dimensions)
    z = plots.z.copy()
    z[:, 0] -= plots.headings
    corners = np.array([[a, b] for a in (-3, 0, 3) for b in (-3, 0, 3)])[:, : z.shape[1]]
    around = one.sensor.measurement.locate(z[:, None] + corners * np.array(one.config.sigma), origin)
    return np.array(~near.contains(around, origin).any(axis=1))


def _offsets(one: _Recorded, plots: _Plots) -> Array:
    """Places of plots from the center of the field of view [m], shape (M, d)."""
    centers = np.array([one.config.view_center(stand) for stand in plots.stands]).reshape(-1, one.dimensions)
    return np.asarray(_located(one, plots) - centers)


def _turns(one: _Recorded, plots: _Plots) -> Array:
    """Rotations of (east, north(, up)) into the frame of a field of view that turns with its platform, (M, d, d)."""
    turns = np.zeros((len(plots.z), one.dimensions, one.dimensions))
    turns[:] = np.eye(one.dimensions)
    if not one.sensor.fixed_view:
        sine, cosine = np.sin(plots.headings), np.cos(plots.headings)
        turns[:, 0, 0], turns[:, 0, 1], turns[:, 1, 0], turns[:, 1, 1] = cosine, -sine, sine, cosine
    return turns


def _located(one: _Recorded, plots: _Plots) -> Array:
    """The places of plots [m], shape (M, d)."""
    if one.config.kind == "position":
        return plots.z
    return plots.stands + one.sensor.measurement.locate(plots.z, np.zeros(one.dimensions))


def _covariance(one: _Recorded, plots: _Plots, k: int) -> Array:
    """Covariance of the place that a plot tells of [m^2], shape (d, d)."""
    d = one.dimensions
    density = from_plots(plots.z[k : k + 1], one.sensor.measurement, plots.stands[k], np.ones(one.n - d))
    covariance: Array = density.P[0, :d, :d]
    return covariance


class _Reading(NamedTuple):
    """Another way to read plots, which would explain what does not fit."""

    meaning: str
    read: Callable[[_Plots], Array]

    def of(self, plots: _Plots) -> _Plots:
        """The plots, read so."""
        return plots._replace(z=self.read(plots))


_AS_IT_IS = _Reading("as it is", lambda plots: plots.z)


def _readings(one: _Recorded) -> list[_Reading]:
    """Other ways to read a sensor's plots."""
    if one.config.kind == "position":
        order = [1, 0, 2][: one.dimensions]
        return [
            _Reading("north before east", lambda plots: plots.z[:, order]),
            _Reading("kilometres", lambda plots: 1000.0 * plots.z),
            _Reading("metres from the sensor instead of the origin", lambda plots: plots.z + plots.stands),
        ]
    column = one.config.numbers.index("azimuth")
    from_heading = one.config.azimuth == "heading"
    found = [
        _Reading("azimuths counted counterclockwise from east", _with(column, lambda p: 0.5 * np.pi - p.z[:, column])),
        _Reading("azimuths counted counterclockwise from north", _with(column, lambda p: -p.z[:, column])),
    ]
    if any(scan.heading for scan in one.scans):
        sign, meaning = (-1.0, "north") if from_heading else (1.0, "the heading of the platform")
        turned = _with(column, lambda p: p.z[:, column] + sign * p.headings)
        found.append(_Reading(f"azimuths counted from {meaning}", turned))
    if one.config.locates:
        found.append(_Reading("kilometres", _with(0, lambda plots: 1000.0 * plots.z[:, 0])))
    return found


def _with(column: int, read: Callable[[_Plots], Array]) -> Callable[[_Plots], Array]:
    """Plots with one of their numbers read in another way."""

    def changed(plots: _Plots) -> Array:
        z = plots.z.copy()
        z[:, column] = read(plots)
        return z

    return changed


def _places(one: _Recorded) -> Iterator[Finding]:
    plots = _Plots.of(one).sample
    outside = _outside(one, plots)
    if outside.sum() >= 5 and outside.mean() > 0.02:
        better = [
            reading.meaning
            for reading in _readings(one)
            if _outside(one, reading.of(plots)).mean() < 0.1 * outside.mean()
        ]
        what = f"Read as {' or '.join(better)} they would lie inside." if better else "Check its size and position."
        yield Finding(
            one.where,
            f"{outside.mean():.1%} of the plots lie outside the field of view, their noise considered; expected are "
            f"none. They are no evidence for tracks there, and pass for false plots. {what}",
            spoils=bool(outside.mean() > 0.2),
        )
    if one.config.locates and len(plots.z) >= 20 and np.isfinite(one.extent):
        away = np.linalg.vector_norm(_offsets(one, plots), axis=-1)
        if np.quantile(away, 0.9) < 0.01 * one.extent:
            other = "" if one.config.kind == "position" else ", or does the azimuth come before the range"
            yield Finding(
                one.where,
                f"9 of 10 plots lie within {np.quantile(away, 0.9):.3g} m of the center of a field of view that is "
                f"{one.extent:.3g} m wide. Are these kilometres{other}? Lengths are in metres.",
            )


def _against_hypotheses(scenario: Scenario, recorded: Sequence[_Recorded]) -> Iterator[Finding]:
    """Plots that support the hypotheses only if they are read in another way."""
    if not scenario.hypotheses:
        return
    for one in recorded:
        evidence = _evidence(scenario, one, _AS_IT_IS)
        for reading in _readings(one):
            other = _evidence(scenario, one, reading)
            if other > 3.0 * evidence + 20.0:
                yield Finding(
                    one.where,
                    f"its first scans support the hypotheses with log LR {evidence:+.0f}, but with {other:+.0f} if its "
                    f"plots are read as {reading.meaning}. Expected is what docs/how-to/sensors.md says: metres, "
                    "radians, east before north, azimuth clockwise from north.",
                )


def _evidence(scenario: Scenario, one: _Recorded, reading: _Reading) -> float:
    """Sum over hypotheses of the log LR of the first scans after their start, where it is positive."""
    total = np.zeros(len(scenario.hypotheses))
    starts = np.array([hypothesis.start for hypothesis in scenario.hypotheses])
    used = np.zeros(len(starts), np.int64)
    for time_s, scan in zip(one.times_s, one.scans, strict=True):
        rows = np.flatnonzero((starts <= time_s) & (used < _FIRST_SCANS))
        if len(rows):
            used[rows] += 1
            at = hypotheses_at(scenario, np.full(len(starts), time_s))
            plots = _Plots.of(one._replace(times_s=np.array([time_s]), scans=(scan,)))
            total[rows] += _log_lr(one, scan, Gaussian(at.x[rows], at.P[rows]), reading.of(plots).z)
        elif (used >= _FIRST_SCANS).all():
            break
    return float(np.maximum(total, 0.0).sum())


def _log_lr(one: _Recorded, scan: Scan, density: Gaussian, z: Array) -> Array:
    """Of one scan, for predicted hypotheses, all plots of it considered for each, shape (K,)."""
    sensor, stand = one.sensor.at(scan.pose), scan.position
    view = sensor.view(one.config.view_center(stand))
    p_d = sensor.detection_probability(density, stand)
    p_d = p_d if view is None else p_d * view.probability_inside(density)
    if not len(z):
        return np.log(np.maximum(1.0 - p_d, 1e-9))
    seen = sensor.measurement.linearise(density, stand)
    S = seen.H @ times_transposed(density.P, seen.H) + seen.R
    nu = innovations(z[None], seen.z[:, None], seen.angular)
    relative = sensor.log_relative(z, stand)
    log_f = sensor.log_rho_f + (0.0 if relative is None else relative)
    log_ratio = log_pdf(nu, Gaussian(np.zeros_like(nu), S[:, None])) - log_f
    ratio = 1.0 - p_d + p_d * np.exp(np.minimum(log_ratio, 50.0)).sum(axis=-1)
    return np.asarray(np.log(np.maximum(ratio, 1e-9)))


def _between_sensors(scenario: Scenario, recorded: Sequence[_Recorded]) -> Iterator[Finding]:
    """Sensors whose plots meet those of the others only if they are read in another way."""
    placed = [one for one in recorded if one.config.locates and sum(len(scan.z) for scan in one.scans) >= 20]
    speed = _speed(scenario)
    if len(placed) < 2 or speed is None:
        return
    for one in placed:
        others = [other for other in placed if other is not one][:_OTHERS]
        meets = _meetings(one, others, _AS_IT_IS, speed)
        for reading in _readings(one):
            better = _meetings(one, others, reading, speed)
            if better >= 20 and better > 3.0 * meets and _stays_inside(one, reading):
                yield Finding(
                    one.where,
                    f"{meets} of its plots lie near plots of other sensors, but {better} if they are read as "
                    f"{reading.meaning}. Expected of all sensors are metres, radians, east before north, azimuth "
                    "clockwise from north.",
                )


def _stays_inside(one: _Recorded, reading: _Reading) -> bool:
    """Whether plots read in another way lie in the field of view no less than as they are."""
    plots = _Plots.of(one).sample
    return bool(_outside(one, reading.of(plots)).mean() <= _outside(one, plots).mean() + 0.02)


def _meetings(one: _Recorded, others: Sequence[_Recorded], reading: _Reading, speed: float) -> int:
    """How many of a sensor's plots have one of another sensor near them, in place and time."""
    plots = _Plots.of(one).rows(slice(_SAMPLE))
    places, near = _located(one, reading.of(plots)), np.zeros(len(plots.z), np.bool_)
    for other in others:
        theirs = _Plots.of(other).rows(slice(_SAMPLE))
        span = max([float(np.median(each.intervals_s)) for each in (one, other) if len(each.scans) > 1], default=1.0)
        reach = 3.0 * (_noise(one, plots) + _noise(other, theirs)) + speed * span
        tree = cKDTree(np.column_stack([_located(other, theirs) / reach, theirs.times_s / span]))
        query = np.column_stack([places / reach, plots.times_s / span])
        distance, _ = tree.query(query, p=np.inf, distance_upper_bound=1.0)
        near |= np.isfinite(distance)
    return int(near.sum())


def _noise(one: _Recorded, plots: _Plots) -> float:
    """A standard deviation of the places of plots [m]."""
    return float(np.sqrt(np.linalg.eigvalsh(_covariance(one, plots, len(plots.z) // 2)).max()))
