"""The filter of a node: every track predicted, expected, updated, in the factor and in the filter that associates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.estimation.association import (
    Choice,
    Clutter,
    Expected,
    Plots,
    expect,
    weigh_and_absorb,
    weights_alone,
    within_reach,
)
from waldnet.common.estimation.detection import Notch
from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian, log_sum_exp
from waldnet.common.estimation.imm import Imm, Modes, predict_modes, predict_probabilities
from waldnet.common.estimation.joint import joint
from waldnet.common.estimation.mixture import Mixture, Reduction, step, step_with, terms
from waldnet.common.estimation.motion import Motion
from waldnet.common.estimation.notch import hypotheses, merged
from waldnet.common.estimation.representation import Share
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.estimation.visibility import seen

#: The honest prior and noise of the association filter.
HONEST = Share(1.0)
#: Log odds of existence go no farther than this, so that a target that has gone is soon believed to be.
SUREST = 7.0
#: A scan with a log weight sum (Eq. 6) above this supports a track.
_LOG_SUPPORT = float(np.log(2.0))
#: Log odds, at the start of a track, of a thing that stands still against a target, for a map of false plots.
DOUBT = 5.0


class Left(NamedTuple):
    """What tracks leave of the plots of a scan.

    Attributes:
        free: probability of each plot to be that of none of them, shape (plots,).
        false: of none that is a target, shape (plots,).
    """

    free: Array
    false: Array


@dataclass(frozen=True)
class LocalFilter:
    """How a track's density is predicted and filtered; a single Gaussian is a mixture of one component.

    Attributes:
        motion: motion model.
        share: the factor's share of prior and process noise.
        tight: a filter of its own associates (theory.md §5).
        choice: how a single Gaussian is associated; None: hypotheses are kept in a mixture.
        reduction: how far a mixture may grow.
        terms: most terms in a report.
        gate_probability: that the target's plot is inside the gate.
    """

    motion: Motion
    share: Share
    tight: bool
    choice: Choice | None
    reduction: Reduction
    terms: int
    gate_probability: float

    @classmethod
    def of(cls, scenario: Scenario, share: Share | None = None) -> LocalFilter:
        """The local filter of a scenario; with another share of the prior than its nodes', if given."""
        fusion = scenario.fusion
        return cls(
            motion=scenario.motion.build(),
            share=share or scenario.share,
            tight=share is None and fusion.mode != "selected" and fusion.association != "factor",
            choice=fusion.choice,
            reduction=fusion.mixture.build(),
            terms=fusion.terms,
            gate_probability=fusion.gate_probability,
        )

    @property
    def honest(self) -> LocalFilter:
        """The filter that associates, alone."""
        return replace(self, share=HONEST, tight=False)

    @property
    def shares(self) -> tuple[Share, ...]:
        """Of the filters of a track, the one that associates last."""
        return (self.share, HONEST) if self.tight else (self.share,)

    def start(self, prior: Gaussian) -> Mixture:
        """Tracks that start with ``prior``, shapes (T, n), (T, n, n)."""
        filters = [share.start(prior) for share in self.shares]
        return self.spread(Gaussian(*(np.stack(arrays) for arrays in zip(*filters, strict=True))))

    def spread(self, density: Gaussian, log_g: Array | None = None) -> Mixture:
        """A mixture of one density, or, of several models, of the same for each.

        Args:
            density: of all filters, shapes (F, T, n), (F, T, n, n).
            log_g: evidence so far, shape (T,); None: 0.
        """
        components = len(self.motion.models) if isinstance(self.motion, Imm) else 1
        log_w = np.full((density.x.shape[1], components), -np.log(components))
        several = Gaussian(*(np.repeat(part[:, :, None], components, axis=2) for part in density))
        return Mixture(log_w, log_w if log_g is None else log_w + log_g[:, None], several)

    @property
    def models(self) -> int:
        """How many motion models a target changes between; 0: there is one."""
        return len(self.motion.models) if isinstance(self.motion, Imm) else 0

    def predict_probabilities(self, log_mu: Array, dt: Array) -> Array:
        """Log probabilities of the motion models after intervals [s], shapes (..., r), (...); of one model, r = 0."""
        if not isinstance(self.motion, Imm):
            return log_mu
        return predict_probabilities(log_mu, self.motion.mode_transition(dt))

    def predict(self, prior: Mixture, *intervals: Array) -> Mixture:
        """Predict all filters of all tracks (Eq. 5), each over its interval [s], shape () or (T,)."""
        if isinstance(self.motion, Imm):
            return self._predict_modes(self.motion, prior, intervals)
        filters = [
            share.predict(
                Gaussian(prior.density.x[i], prior.density.P[i]), self.motion, dt[..., None] if dt.ndim else dt
            )
            for i, (share, dt) in enumerate(zip(self.shares, intervals, strict=False))
        ]
        return prior._replace(density=Gaussian(*(np.stack(arrays) for arrays in zip(*filters, strict=True))))

    def _predict_modes(self, imm: Imm, prior: Mixture, intervals: tuple[Array, ...]) -> Mixture:
        """Several models; each filter has its own weights, or the center could not predict the factor as its node."""
        logs = (prior.log_g, prior.log_w) if self.tight else (prior.log_g,)
        modes = [
            predict_modes(Modes(log_mu, Gaussian(x, P)), imm, dt, share.multiplicity)
            for log_mu, x, P, dt, share in zip(logs, *prior.density, intervals, self.shares, strict=False)
        ]
        density = Gaussian(*(np.stack(arrays) for arrays in zip(*(mode.densities for mode in modes), strict=True)))
        log_w = modes[-1].log_mu
        return Mixture(log_w - log_sum_exp(log_w)[:, None], modes[0].log_mu, density)

    def expect(
        self, density: Gaussian, sensor: Sensor, stand: Array, center: Array, visible: Array | None = None
    ) -> Expected:
        """What a sensor will see of predicted tracks.

        Args:
            density: of all filters, shapes (F, T, C, n), (F, T, C, n, n).
            sensor: the sensor model.
            stand: where it stands [m], shape (d,).
            center: of its field of view [m], shape (d,).
            visible: probability of each track to be visible to it, shape (T,); None: all are.
        """
        p_d = sensor.without_notch.detection_probability(Gaussian(density.x[-1], density.P[-1]), stand)
        p_d = p_d if visible is None else p_d * visible[:, None]
        clutter = Clutter(p_d, np.array(sensor.log_rho_f), self.gate_probability, sensor.view(center))
        return expect(density, sensor.measurement.linearise(density, stand), clutter)

    def near(self, expected: Expected, plots: Plots, sensor: Sensor, stand: Array) -> Plots:
        """The plots near the tracks, how dense false ones are there, and whether tracks that have them are in view.

        Args:
            expected: the tracks as the sensor will see them.
            plots: that all tracks share, z of shape (M, m), or of every track its own, z of shape (T, 1, M, m).
            sensor: the sensor model.
            stand: where it stands [m], shape (d,).

        Returns:
            what ``shared`` and ``update`` take.
        """
        relative = sensor.log_relative(plots.z, stand)
        if relative is not None and plots.log_relative is not None:
            relative = relative + plots.log_relative
        plots = plots._replace(log_relative=plots.log_relative if relative is None else relative)
        return within_reach(expected, plots)

    def update(self, predicted: Mixture, expected: Expected, near: Plots, sensor: Sensor, stand: Array) -> Mixture:
        """Filter a scan.

        Args:
            predicted: the tracks.
            expected: the same, as the sensor will see them.
            near: the plots near them.
            sensor: the sensor model.
            stand: where it stands [m], shape (d,).

        Returns:
            the tracks after the scan.
        """
        if isinstance(sensor.detection, Notch):
            given = hypotheses(expected, near, sensor.detection, stand)
            if self.choice is None:
                return step_with(predicted, *given, self.reduction)
            density, log_p_bar, log_q_bar = merged(given, self.choice)
        elif self.choice is None:
            return step(predicted, expected, near, self.reduction)
        else:
            density, log_p_bar, log_q_bar = weigh_and_absorb(expected, near, self.choice)
        if not isinstance(self.motion, Imm):
            return Mixture(predicted.log_w, predicted.log_g + log_p_bar, density)
        log_w = predicted.log_w + np.where(np.isfinite(log_q_bar), log_q_bar, 0.0)
        return Mixture(log_w - log_sum_exp(log_w)[:, None], predicted.log_g + log_p_bar, density)

    def shared(
        self,
        predicted: Mixture,
        expected: Expected,
        near: Plots,
        plots: int,
        sensor: Sensor,
        stand: Array,
        existence: Array,
        target: Array | None = None,
    ) -> tuple[Plots, Left]:
        """Associate tracks that share the plots of a scan (Eq. 21).

        Args:
            predicted: the tracks.
            expected: the same, as the sensor will see them.
            near: the plots near them, of one scan.
            plots: how many the scan has.
            sensor: the sensor model.
            stand: where it stands [m], shape (d,).
            existence: probability of each track to exist, before the scan, shape (T,).
            target: probability of each track to be that of a target, if it exists, shape (T,); None: all are.

        Returns:
            the plots, false ones the denser the more the other tracks claim them; and what these leave.
        """
        alone = _log_p_star(expected, near, sensor, stand)
        log_nu, *left = joint(predicted.log_w, alone, near.number, plots, existence, target)
        log_relative = -log_nu if near.log_relative is None else near.log_relative - log_nu
        return near._replace(log_relative=log_relative), Left(*left)

    def visible(
        self, v: Array, predicted: Mixture, expected: Expected, near: Plots, sensor: Sensor, stand: Array
    ) -> Array:
        """Probability of each track to be visible to a sensor, after a scan, shape (T,).

        Args:
            v: before, shape (T,).
            predicted: the tracks.
            expected: the same, as the sensor will see them, if they are visible with probability v.
            near: the plots near them.
            sensor: the sensor model.
            stand: where it stands [m], shape (d,).
        """
        weights = predicted.log_w[..., None] + _log_p_star(expected, near, sensor, stand)
        return seen(v, log_sum_exp(log_sum_exp(weights)))

    def supported(self, predicted: Mixture, expected: Expected, near: Plots, sensor: Sensor, stand: Array) -> BoolArray:
        """Which tracks a scan supports: each taken by itself, the scan makes it at least twice as probable.

        Args:
            predicted: the tracks.
            expected: the same, as the sensor will see them.
            near: the plots near them, not associated jointly: of two tracks of one target the plot supports both.
            sensor: the sensor model.
            stand: where it stands [m], shape (d,).

        Returns:
            shape (T,).
        """
        weights = predicted.log_w[..., None] + _log_p_star(expected, near, sensor, stand)
        return np.asarray(log_sum_exp(log_sum_exp(weights)) > _LOG_SUPPORT)

    def report(self, mixture: Mixture) -> Mixture:
        """The terms of a report."""
        if self.choice is not None:
            return mixture
        return terms(mixture, self.terms)


def _log_p_star(expected: Expected, near: Plots, sensor: Sensor, stand: Array) -> Array:
    """Log p*_j (Eq. 6) of every component in the filter that associates, shape (T, C, 1 + M)."""
    if isinstance(sensor.detection, Notch):
        log_p_star: Array = hypotheses(expected, near, sensor.detection, stand).log_p_star[-1]
        return log_p_star
    return weights_alone(expected, near)
