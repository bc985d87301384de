"""The life of a track: its test, and its end where nobody sees it (theory.md §7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.estimation.field_of_view import FieldOfView
from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian
from waldnet.common.estimation.motion import Motion
from waldnet.common.estimation.pose import Outlook, SensorPose
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.estimation.sprt import CONFIRMED, DELETED, Existence, Thresholds, decide, decide_with_life
from waldnet.common.life_config import LifeConfig
from waldnet.common.messages import Decision, DecisionKind
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.picture import Picture

#: By chance alone a sensor misses a target as often in a row as it may with this probability, or so often at least.
_CHANCE, _FEW_SCANS = 1e-5, 3
#: Of a sensor whose detection probability depends on the target.
_SOME_P_D = 0.5
#: So many scans of the slowest sensor of all, and a track that nobody can see is lost.
_LOST_SCANS = 5.0
#: A position with a standard deviation of more than this share of the largest field of view is not known.
_LOST_SHARE = 0.25
#: A sensor should see a track that lies in its field of view with at least this probability.
_IN_VIEW = 0.5


class View(NamedTuple):
    """What a sensor looks at.

    Attributes:
        config: the sensor as the scenario describes it.
        sensor: its model.
        scans: it may well miss a target that is there in so many scans,
        hidden_s: or for so long [s].
    """

    config: SensorConfig
    sensor: Sensor
    scans: float
    hidden_s: float

    @classmethod
    def of(cls, config: SensorConfig, motion: Motion) -> View:
        """The view of a sensor of a scenario."""
        p_d = config.p_d or _SOME_P_D
        scans = _FEW_SCANS if p_d == 1.0 else max(np.ceil(np.log(_CHANCE) / np.log1p(-p_d)), _FEW_SCANS)
        hidden_s = 0.0 if config.visibility is None else config.visibility.hidden_for
        return cls(config, config.build(motion), float(scans), hidden_s)


class Ending(NamedTuple):
    """How tracks end that nobody sees.

    Attributes:
        coasting_s: without a plot for so long, a confirmed track is coasting [s]; None: for longer than any sensor
            that should see it may well miss it.
        lost_s: without a plot for so long, a track may be lost [s]; None: for a few scans of the slowest sensor.
        lost_below: it is, if it lies in any field of view with less than this probability,
        lost_sigma: or if the standard deviation of its position is larger than this [m].
    """

    coasting_s: float | None
    lost_s: float | None
    lost_below: float
    lost_sigma: float


@dataclass(frozen=True)
class Life:
    """The test of every track after a measurement time, and the end of tracks that nobody sees.

    Attributes:
        limits: thresholds of the test; None: nothing is decided, and nothing ends.
        ending: None: tracks that nobody sees stay.
        views: of the sensors.
        dimensions: of space.
        memory_s: sensors that turn may look again where they have looked in so long [s].
    """

    limits: Thresholds | None
    ending: Ending | None
    views: tuple[View, ...]
    dimensions: int
    memory_s: float

    @classmethod
    def of(cls, scenario: Scenario) -> Life:
        """The life of a scenario's tracks."""
        motion = scenario.motion.build()
        views = tuple(View.of(sensor, motion) for sensor in scenario.sensors)
        limits = scenario.decision.thresholds if scenario.decision.enabled else None
        return cls(limits, _ending(scenario.life, scenario.extent), views, motion.dimensions, scenario.stay)

    def begin(self) -> tuple[Outlook, ...]:
        """Where the sensors look before their first scan."""
        configs = [view.config for view in self.views]
        return tuple(
            Outlook(config.pose(self.dimensions), max(config.scan_interval, config.spacing)) for config in configs
        )

    def look(
        self, outlooks: Sequence[Outlook], poses: Mapping[int, SensorPose], elapsed_ns: int
    ) -> tuple[Outlook, ...]:
        """Where the sensors look after a time, at which those with ``poses``, by number, have scanned."""
        return tuple(
            outlook.after(poses.get(number), elapsed_ns, self.memory_s) for number, outlook in enumerate(outlooks)
        )

    def judge(self, picture: Picture, time_ns: int, outlooks: Sequence[Outlook]) -> tuple[Picture, list[Decision]]:
        """Test all tracks, and end those that nobody sees.

        Args:
            picture: with all reports of a measurement time.
            time_ns: that time.
            outlooks: of the sensors.

        Returns:
            the picture after the test, and what was decided.
        """
        if self.limits is None:
            return picture, []
        if self.ending is None:
            verdict = decide(picture.log_lr, picture.status, self.limits)
            decisions = [
                decision_of("deleted" if verdict.rejected[row] else "confirmed", picture, row)
                for row in np.nonzero(verdict.status != picture.status)[0].tolist()
            ]
            return picture._replace(log_lr=verdict.log_lr, status=verdict.status), decisions
        existence = Existence(picture.log_lr, picture.log_left)
        existence, verdict = decide_with_life(existence, picture.status, self.limits)
        told = picture._replace(log_lr=verdict.log_lr)
        decisions = [
            decision_of("deleted" if verdict.rejected[row] else "confirmed", told, row)
            for row in np.nonzero(verdict.status != picture.status)[0].tolist()
        ]
        picture = picture._replace(log_lr=existence.log_lr, log_left=existence.log_left, status=verdict.status)
        return self._end_unseen(picture, self.ending, time_ns, outlooks, decisions)

    def _end_unseen(
        self, picture: Picture, ending: Ending, time_ns: int, outlooks: Sequence[Outlook], decisions: list[Decision]
    ) -> tuple[Picture, list[Decision]]:
        """The picture without tracks that nobody sees, and with those coasting that should have been seen."""
        unseen_s = (time_ns - picture.supported_ns) / NS_PER_S
        views, looks_s = self._swept(outlooks)
        lost_s = _LOST_SCANS * float(looks_s.max()) if ending.lost_s is None else ending.lost_s
        patience_s = self._patience_s(ending, looks_s)
        shortest = min(lost_s, *patience_s)
        rows = np.flatnonzero((unseen_s >= shortest) & (picture.status != DELETED))
        coasting, status = np.zeros(len(picture.ids), np.bool_), picture.status.copy()
        if len(rows):
            unseen_s, d = unseen_s[rows], self.dimensions
            position = Gaussian(picture.fused_x[rows, :d], picture.fused_P[rows, :d, :d])
            inside = self._inside(position, views, outlooks)
            coasting[rows] = (status[rows] == CONFIRMED) & (unseen_s >= _longest(patience_s, inside))
            unknown = np.linalg.eigvalsh(position.P)[:, -1] > ending.lost_sigma**2
            nowhere = 1.0 - np.prod(1.0 - inside, axis=-1) < ending.lost_below
            lost = rows[(unseen_s >= lost_s) & (unknown | nowhere)]
            status[lost] = DELETED
            decisions = [*decisions, *(decision_of("lost", picture, row) for row in lost.tolist())]
        return picture._replace(status=status, coasting=coasting & (status == CONFIRMED)), decisions

    def _swept(self, outlooks: Sequence[Outlook]) -> tuple[list[FieldOfView], Array]:
        """What the sensors look at as they turn, and the mean time between two looks at a place [s], shape (S,)."""
        swept, looks_s = list[FieldOfView](), list[float]()
        for view, outlook in zip(self.views, outlooks, strict=True):
            now = view.sensor.at(outlook.pose).field_of_view
            whole = now if view.sensor.fixed_view else now.swept(outlook.left, outlook.right)
            swept.append(whole)
            looks_s.append(outlook.interval_s * (1.0 if whole == now else whole.volume / now.volume))
        return swept, np.array(looks_s)

    def _inside(self, position: Gaussian, views: Sequence[FieldOfView], outlooks: Sequence[Outlook]) -> Array:
        """Probability of positions to lie in each sensor's field of view, shapes (R, d), (R, d, d) to (R, S)."""
        inside = (
            field.probability_inside(position, view.config.view_center(outlook.pose.position))
            for field, view, outlook in zip(views, self.views, outlooks, strict=True)
        )
        return np.stack(list(inside), axis=-1)

    def _patience_s(self, ending: Ending, looks_s: Array) -> Array:
        """After how long without a plot a track that a sensor should see is coasting, shape (S,) [s]."""
        if ending.coasting_s is not None:
            return np.full(len(self.views), ending.coasting_s)
        patience_s = looks_s * [view.scans for view in self.views]
        return np.maximum(patience_s, [view.hidden_s for view in self.views])


def _longest(patience_s: Array, inside: Array) -> Array:
    """The patience of the slowest sensor that should see a track, shapes (S,), (R, S) to (R,) [s]."""
    should: BoolArray = inside >= _IN_VIEW
    should |= ~should.any(axis=-1, keepdims=True)
    return np.asarray(np.where(should, patience_s, 0.0).max(axis=-1))


def _ending(config: LifeConfig | None, extent: float) -> Ending | None:
    """How tracks end; None where they have no life."""
    if config is None:
        return None
    return Ending(
        coasting_s=config.coasting_after,
        lost_s=config.lost_after,
        lost_below=config.lost_below,
        lost_sigma=_LOST_SHARE * extent if config.lost_sigma is None else config.lost_sigma,
    )


def decision_of(kind: DecisionKind, picture: Picture, row: int, into: int = -1) -> Decision:
    """A decision about the track in a row of a picture."""
    return Decision(
        kind=kind,
        track=int(picture.ids[row]),
        time_ns=int(picture.times_ns[row]),
        log_lr=float(picture.log_lr[row]),
        log_lr_total=float(picture.log_lr_total[row]),
        scans=int(picture.scans[row]),
        into=into,
    )
