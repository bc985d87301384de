"""What the figures of a run are drawn from: of bounded size, however long the run goes on."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Array, BoolArray
from waldnet.common.estimation.sprt import Status
from waldnet.common.messages import Scan, Tracks
from waldnet.common.quantities import NS_PER_S

#: Of more tracks only those that were ever confirmed are drawn, at most so many that have ended: the newest.
MOST_TRACKS = 200
#: Times of one track.
_MOST_TIMES = 1000
#: Places of one sensor.
_MOST_STANDS = 1000
#: Plots of all sensors together.
_MOST_PLOTS = 100_000
#: What log LR is drawn as at least; log LR of an impossible scan is -inf.
_LOWEST = -1e3


class ThinnedRows:
    """Rows of numbers, evenly thinned out: whenever there are too many, every second one goes. The last one stays."""

    def __init__(self, width: int, most: int) -> None:
        """Empty.

        Args:
            width: numbers of a row.
            most: rows to keep, 2 or more.
        """
        self._width, self._most = width, most
        self._stride, self.count = 1, 0
        self._kept, self._last = array("d"), array("d")

    def add(self, row: Sequence[float]) -> None:
        """Add a row."""
        self._last = array("d", row)
        if self.count % self._stride == 0:
            self._kept.extend(self._last)
            if len(self._kept) > self._most * self._width:
                self._kept = array("d", self._table()[::2].ravel())
                self._stride *= 2
        self.count += 1

    def rows(self) -> Array:
        """What was kept, with the last row, shape (K, width)."""
        table = self._table()
        if self.count and (self.count - 1) % self._stride:
            table = np.vstack([table, self._last])
        return table

    def _table(self) -> Array:
        return np.array(self._kept, dtype=np.float64).reshape(-1, self._width)


class History(NamedTuple):
    """One track over time, as it is drawn.

    Attributes:
        times_s: measurement times, shape (K,).
        reached: log LR before a reset at that time, shape (K,).
        log_lr: after it, shape (K,).
        x: fused positions east and north [m], shape (K, 2).
        P: their covariances, shape (K, 2, 2).
        coasting: whether it was coasting, shape (K,).
        supported_s: time of the last plot that was its own.
        status: the last one.
        confirmed: whether it ever was.
    """

    times_s: Array
    reached: Array
    log_lr: Array
    x: Array
    P: Array
    coasting: BoolArray
    supported_s: float
    status: Status
    confirmed: bool


class _Course:
    """One track so far."""

    def __init__(self) -> None:
        self._rows = ThinnedRows(9, _MOST_TIMES)
        self._log_lr = self._total = self._supported_s = 0.0
        self.status, self.confirmed = Status.TENTATIVE, False

    def add(
        self, time_s: float, status: int, log_lr: float, total: float, supported_s: float, place: Sequence[float]
    ) -> None:
        reached, coasting = self._log_lr + (total - self._total), float(status == Status.COASTING)
        self._rows.add((time_s, reached if isfinite(reached) else _LOWEST, max(log_lr, _LOWEST), coasting, *place))
        self._log_lr, self._total, self._supported_s = log_lr, total, supported_s
        self.status = Status(status)
        self.confirmed |= self.status == Status.CONFIRMED

    def history(self) -> History:
        times_s, reached, log_lr, coasting, *x, xx, xy, yy = self._rows.rows().T
        P = np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)
        return History(
            times_s=times_s,
            reached=reached,
            log_lr=log_lr,
            x=np.stack(x, axis=-1),
            P=P,
            coasting=coasting > 0.0,
            supported_s=self._supported_s,
            status=self.status,
            confirmed=self.confirmed,
        )


class Sketch:
    """Tracks, plots and places of sensors of one run, thinned.

    Attributes:
        scenario: what ran.
        omitted: how many tracks were let go of, by whether they were ever confirmed.
        headings: which way the platforms of sensors pointed last [rad].
    """

    def __init__(self, scenario: Scenario) -> None:
        """Empty."""
        self.scenario = scenario
        self._courses: dict[int, _Course] = {}
        self._live: set[int] = set()
        self._ended: dict[int, None] = {}
        self._outcome: Counter[Status] = Counter()
        self.omitted: Counter[bool] = Counter()
        self.headings: dict[str, float] = {}
        motion = scenario.motion.build()
        self._measurements = {sensor.name: sensor.build(motion).measurement for sensor in scenario.sensors}
        self._rays = {sensor.name for sensor in scenario.sensors if not sensor.locates}
        most = max(_MOST_PLOTS // len(scenario.sensors), 2)
        self._plots = {sensor.name: ThinnedRows(4, most) for sensor in scenario.sensors}
        self._stands = {sensor.name: ThinnedRows(2, _MOST_STANDS) for sensor in scenario.sensors}

    def add_picture(self, tracks: Tracks) -> None:
        """Add the picture of the next measurement time."""
        time_s, now = self.scenario.to_seconds(tracks.time_ns), tracks.ids.tolist()
        places = np.column_stack([tracks.x[:, :2], tracks.P[:, 0, 0], tracks.P[:, 0, 1], tracks.P[:, 1, 1]])
        supported_s = (tracks.supported_ns - self.scenario.epoch_ns) / NS_PER_S
        columns = (tracks.status, tracks.log_lr, tracks.log_lr_total, supported_s, places)
        for track, *values in zip(now, *(column.tolist() for column in columns), strict=True):
            if track not in self._courses:
                self._courses[track] = _Course()
            self._courses[track].add(time_s, *values)
        for track in sorted(self._live.difference(now)):
            self._outcome[self._courses[track].status] += 1
            self._ended[track] = None
        self._live = set(now)
        self._omit()

    def add_scan(self, scan: Scan) -> None:
        """Add the plots of one scan."""
        stand = scan.position[:2]
        self.headings[scan.sensor] = scan.heading
        self._stands[scan.sensor].add(stand.tolist())
        if len(scan.z):
            at = self._measurements[scan.sensor].locate(scan.z, scan.position)[:, :2]
            for way in (at - stand).tolist():
                self._plots[scan.sensor].add((*stand.tolist(), *way))

    def __len__(self) -> int:
        """How many tracks are kept."""
        return len(self._courses)

    @property
    def outcome(self) -> Counter[Status]:
        """How many tracks have which status in the end."""
        return self._outcome + Counter(self._courses[track].status for track in self._live)

    def histories(self) -> dict[int, History]:
        """The tracks to draw, by id."""
        few = len(self._courses) + self.omitted.total() <= MOST_TRACKS
        return {track: course.history() for track, course in sorted(self._courses.items()) if few or course.confirmed}

    def plots(self, *, rays: bool) -> tuple[Array, int]:
        """Plots as they are drawn.

        Args:
            rays: those without a range, else all others.

        Returns:
            where the sensor stood and the way from there [m], shape (K, 4); and how many plots there were.
        """
        rows = [rows for name, rows in self._plots.items() if (name in self._rays) == rays]
        return np.concatenate([np.empty((0, 4)), *(one.rows() for one in rows)]), sum(one.count for one in rows)

    def stands(self, sensor: str) -> Array:
        """Where a sensor stood, shape (K, 2); none where none of its scans was seen."""
        return self._stands[sensor].rows()

    def _omit(self) -> None:
        """Let go of tracks that have ended and will not be drawn."""
        if len(self._courses) + self.omitted.total() > MOST_TRACKS:
            for track in [track for track in self._ended if not self._courses[track].confirmed]:
                self._let_go(track)
        while len(self._ended) > MOST_TRACKS:
            self._let_go(next(iter(self._ended)))

    def _let_go(self, track: int) -> None:
        del self._ended[track]
        self.omitted[self._courses.pop(track).confirmed] += 1
