"""What one sensor sees of a tracker's tracks: scan by scan, which plots are theirs, which are left, which are false."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import expit, ndtr

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.estimation import clutter_map
from waldnet.common.estimation.association import Expected, Plots
from waldnet.common.estimation.clutter_map import ClutterMap, ClutterModel
from waldnet.common.estimation.gaussian import Array, BoolArray
from waldnet.common.estimation.mixture import Mixture
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.local_filter import DOUBT, Left, LocalFilter
from waldnet.sensor_node.state import Look, Tracks


class Seen(NamedTuple):
    """Tracks after a scan, and what else the scan tells.

    Attributes:
        mixture: the tracks.
        visible: their probabilities to be visible to each sensor, shape (T, S).
        left: what they leave of the plots; None: not asked for.
        supported: which tracks a plot supports, shape (T,); not asked for: shape (0,).
    """

    mixture: Mixture
    visible: Array
    left: Left | None
    supported: BoolArray


@dataclass(frozen=True)
class Sight:
    """A sensor, as a tracker uses it.

    Attributes:
        config: the sensor as the scenario describes it.
        sensor: its model.
        number: of it in the scenario.
        clutter: what is believed of its false plots, if it maps them; else None.
        joint: tracks that share plots are associated jointly (Eq. 21).
        claimed: a plot that belongs to the tracks with at least this probability starts none; None: none does.
        min_speed: targets are faster [m/s].
        supporting: it is asked which tracks a plot supports.
        dimensions: of space.
    """

    config: SensorConfig
    sensor: Sensor
    number: int
    clutter: ClutterModel | None
    joint: bool
    claimed: float | None
    min_speed: float
    supporting: bool
    dimensions: int

    @classmethod
    def of(cls, scenario: Scenario, number: int) -> Sight:
        """A sensor of a scenario; bearings start no track."""
        config, motion = scenario.sensors[number], scenario.motion.build()
        initiation = scenario.initiation
        return cls(
            config=config,
            sensor=config.build(motion),
            number=number,
            clutter=config.clutter_model(motion),
            joint=scenario.joint,
            claimed=None if initiation is None or not config.locates else initiation.claimed,
            min_speed=0.0 if initiation is None else initiation.min_speed,
            supporting=scenario.life is not None,
            dimensions=motion.dimensions,
        )

    @property
    def sharing(self) -> bool:
        """Whether it is asked which plots belong to none of the tracks."""
        return self.claimed is not None or self.clutter is not None

    def expect(self, local: LocalFilter, predicted: Mixture, pose: SensorPose, visible: Array) -> Expected:
        """What the sensor will see of predicted tracks.

        Args:
            local: the filter that predicted them.
            predicted: the tracks.
            pose: of the sensor then.
            visible: probability of each track to be visible to it, shape (T,).
        """
        known, stand = None if self.sensor.visibility is None else visible, pose.position
        return local.expect(predicted.density, self.sensor.at(pose), stand, self.config.view_center(stand), known)

    def near(
        self, local: LocalFilter, predicted: Mixture, expected: Expected, look: Look, log_odds: Array
    ) -> tuple[Plots, Left | None]:
        """The plots near the tracks, and what these leave; None: not asked for.

        Args:
            local: the filter of the tracks.
            predicted: the tracks.
            expected: the same, as the sensor will see them.
            look: the scan.
            log_odds: of the tracks to exist, shape (T,).
        """
        near = local.near(expected, look.plots, self.sensor.at(look.pose), look.pose.position)
        return self._associate(local, predicted, expected, near, look, log_odds)

    def _associate(
        self, local: LocalFilter, predicted: Mixture, expected: Expected, near: Plots, look: Look, log_odds: Array
    ) -> tuple[Plots, Left | None]:
        """``near``, of plots that are near the tracks each by itself."""
        sensor, stand = self.sensor.at(look.pose), look.pose.position
        if look.plots.z.ndim > 2 or not (self.sharing or (self.joint and len(log_odds) > 1)):
            return near, None
        plots, odds = len(look.plots.z), self._told(log_odds)
        shared, left = local.shared(predicted, expected, near, plots, sensor, stand, expit(odds))
        if self.clutter is not None and self.claimed is not None:
            # What stands still begins like a target and has evidence like one (theory.md §13).
            doubted, target = expit(odds - DOUBT), self._moving(predicted)
            _, known = local.shared(predicted, expected, near, plots, sensor, stand, doubted, target)
            left = left._replace(false=known.false)
        return shared if self.joint else near, left

    def _told(self, log_odds: Array) -> Array:
        """Log odds of tracks to exist: with a map, what others found is no less probable than not, shape (T,)."""
        if self.claimed is None and self.clutter is not None:
            log_odds = np.where(log_odds > -np.inf, np.maximum(log_odds, 0.0), log_odds)
        return log_odds

    def _moving(self, predicted: Mixture) -> Array | None:
        """Probability of each track to be faster than targets are at least, along its course, shape (T,)."""
        if self.min_speed == 0.0:
            return None
        w, (x, P), d = np.exp(predicted.log_w), predicted.density, self.dimensions
        velocity = np.vecmat(w, x[-1, ..., d : 2 * d])
        variance = np.vecdot(w, P[-1].diagonal(axis1=-2, axis2=-1)[..., d : 2 * d].mean(axis=-1))
        faster: Array = ndtr((np.linalg.vector_norm(velocity, axis=-1) - self.min_speed) / np.sqrt(variance))
        return faster

    def filter(
        self, local: LocalFilter, predicted: Mixture, expected: Expected, look: Look, log_odds: Array
    ) -> Mixture:
        """Tracks after a scan; arguments as for ``near``."""
        near, _ = self.near(local, predicted, expected, look, log_odds)
        return local.update(predicted, expected, near, self.sensor.at(look.pose), look.pose.position)

    def look(self, local: LocalFilter, tracks: Tracks, predicted: Mixture, expected: Expected, look: Look) -> Seen:
        """``filter``, and what else the scan tells."""
        visible, sensor, stand = tracks.visible, self.sensor.at(look.pose), look.pose.position
        by_itself = local.near(expected, look.plots, sensor, stand)
        near, left = self._associate(local, predicted, expected, by_itself, look, tracks.log_odds)
        if self.sensor.visibility is not None:
            v, visible = visible[:, self.number], visible.copy()
            visible[:, self.number] = local.visible(v, predicted, expected, near, sensor, stand)
        supported = np.empty(0, np.bool_)
        if self.supporting:
            supported = local.supported(predicted, expected, by_itself, sensor, stand)
        return Seen(local.update(predicted, expected, near, sensor, stand), visible, left, supported)

    def mapped(self, seen: ClutterMap | None, look: Look) -> Look:
        """A scan with the density of false plots that earlier scans tell of."""
        if self.clutter is None or seen is None or look.plots.z.ndim > 2:
            return look
        relative = clutter_map.log_relative(seen, self.clutter, look.plots.z, look.pose.position)
        return look._replace(plots=look.plots._replace(log_relative=relative))

    def learned(self, seen: ClutterMap | None, look: Look, left: Left | None) -> ClutterMap | None:
        """The map of false plots after a scan."""
        if self.clutter is None or seen is None or left is None:
            return seen
        stand, turned = look.pose.position, self.sensor.at(look.pose).field_of_view != self.sensor.field_of_view
        center, heading = self.config.view_center(stand), look.pose.heading if turned else 0.0
        return clutter_map.learn(seen, self.clutter, look.plots.z, left.false, look.time_ns, stand, center, heading)

    def unclaimed(self, look: Look, left: Left | None) -> tuple[Look, Array]:
        """The scan with what the tracks leave to later ones, and its plots from which tracks may start."""
        z = look.plots.z
        if left is None:
            return look, np.empty((0, z.shape[-1]))
        with np.errstate(divide="ignore"):  # surely claimed
            look = look._replace(log_free=np.log(left.free))
        if self.claimed is None:
            return look, np.empty((0, z.shape[-1]))
        quiet = left.free > 1.0 - self.claimed
        if look.plots.log_relative is not None and self.config.clutter_map is not None:
            quiet &= look.plots.log_relative < np.log(self.config.clutter_map.start_below)
        return look, z[quiet]
