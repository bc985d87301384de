"""Interacting multiple model (IMM): a target that changes between motion models.

Every hypothesis on the model in force, a *mode*, has its own Gaussian. The mode is a Markov chain in continuous time,
so any interval is allowed. Axis -1 of weights, -2 of means, -3 of covariances counts the modes; all before are a batch.

One step: ``mix`` (the chain moves on, and each mode gathers what the others become), ``predict_models``, then any
filter per mode, whose evidence updates the weights. Weights are logarithms wherever they may be tiny.

References:
    theory.md Eq. (1a) to (1c); Blom & Bar-Shalom, The interacting multiple model algorithm for systems with Markovian
    switching coefficients, IEEE TAC 33(8), 1988; Bar-Shalom, Li & Kirubarajan, Estimation with applications to
    tracking and navigation, §11.6.6.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from waldnet.common.estimation.association import Clutter, Plots, pdaf
from waldnet.common.estimation.gaussian import Array, Gaussian, as_array, draw_noise, log_sum_exp, moments
from waldnet.common.estimation.motion import (
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    Kinematic,
    Motion,
    predict,
)
from waldnet.common.estimation.sensing import Linearised


class Imm(NamedTuple):
    """Several models of one target; make one with ``Imm.of``.

    The time that the target stays with a model is exponential with mean ``sojourn``; then it takes any of the others.
    The generator of the chain has ``-1 / sojourn`` on its diagonal and ``1 / (sojourn (r - 1))`` elsewhere, and its
    stationary probabilities are 1 / r.

    It is a motion model too, that of ``nominal``, for those who predict with a single F and Q.

    Attributes:
        models: r of them, of states of the same kind.
        sojourn: mean time until the target takes another model [s].
        psd: of the nominal model; None: the mean of the models'.
    """

    models: tuple[Kinematic, ...]
    sojourn: float
    psd: float | None = None

    @classmethod
    def of(cls, models: tuple[Kinematic, ...], sojourn: float, psd: float | None = None) -> Imm:
        """Several models of one target.

        Raises:
            ValueError: without a model, with states of several kinds, or when the sojourn is not positive.
        """
        if len({(model.n, model.dimensions) for model in models}) != 1:
            raise ValueError(f"{models}: at least one model is needed, and all must share one state")
        if not sojourn > 0.0:
            raise ValueError(f"sojourn = {sojourn}: is not positive")
        return cls(models, sojourn, psd)

    @property
    def n(self) -> int:
        """Size of the state."""
        return self.models[0].n

    @property
    def dimensions(self) -> int:
        """Size of the position, 2 or 3."""
        return self.models[0].dimensions

    @property
    def nominal(self) -> Kinematic:
        """The one linear model in the place of all: mean turn rate, and mean psd unless another is given.

        The densities that the models predict over dt, averaged with the stationary probabilities, have the mean
        ``mean(F_i) x``. Taken over a whole interval that is no motion model: two intervals do not make their sum (with
        turns to either side the speed would shrink by cos(turn_rate dt) at every step, however the steps are cut), and
        the covariance depends on x. Averaged again and again over ever shorter intervals it has a limit, linear and
        the same for all x: the models' mean drift and mean spectral density. Its F and Q compose, so it is this model.

        For models that differ in psd only it is exact for a single step. That a target keeps turning to one side for a
        while the limit does not see; as noise that is worth ``turning_psd``, which ``psd`` should then contain.
        """
        psd = float(np.mean([model.psd for model in self.models])) if self.psd is None else self.psd
        if isinstance(self.models[0], ConstantAcceleration):
            return ConstantAcceleration(self.dimensions, psd)
        rate = float(np.mean(self._turn_rates))
        return CoordinatedTurn(self.dimensions, psd, rate) if rate else ConstantVelocity(self.dimensions, psd)

    @property
    def _turn_rates(self) -> list[float]:
        return [model.turn_rate if isinstance(model, CoordinatedTurn) else 0.0 for model in self.models]

    def turning_psd(self, speed: float, horizon: float) -> float:
        """What the spread of turn rates is worth as white-noise acceleration, to first order (Eq. 1c).

        The acceleration across the velocity, ``(omega - mean omega) speed``, has the variance of the turn rates times
        speed^2 and the correlation ``exp(-lambda t)`` of the chain, lambda = r / ((r - 1) sojourn). White noise of

            q = var(omega) speed^2 (lambda h - 1 + exp(-lambda h)) / (lambda^2 h)

        on each horizontal axis spreads the velocity over the horizon h alike, in the mean over its directions; over
        less it spreads too much, over more too little.

        Args:
            speed: of the target [m/s].
            horizon: over how long [s]; for a filter its memory, a few scans.

        Returns:
            power spectral density [m^2/s^3].
        """
        u = horizon * self._rate
        # The series where all digits would cancel.
        part = (u + np.expm1(-u)) / u**2 if u > 1e-5 else 0.5 - u / 6.0
        return float(np.var(self._turn_rates) * speed**2 * horizon * part)

    @property
    def _rate(self) -> float:
        """At which the chain forgets [1/s]."""
        r = len(self.models)
        return r / (max(r - 1, 1) * self.sojourn)

    def transition(self, dt: ArrayLike) -> Array:
        """F of the nominal model over ``dt`` seconds, shape (...) to (..., n, n)."""
        return self.nominal.transition(dt)

    def noise(self, dt: ArrayLike) -> Array:
        """Q of the nominal model over ``dt`` seconds, shape (...) to (..., n, n)."""
        return self.nominal.noise(dt)

    def transitions(self, dt: ArrayLike) -> Array:
        """F of every model over ``dt`` seconds, shape (...) to (..., r, n, n)."""
        return np.stack([model.transition(dt) for model in self.models], axis=-3)

    def noises(self, dt: ArrayLike) -> Array:
        """Q of every model over ``dt`` seconds, shape (...) to (..., r, n, n)."""
        return np.stack([model.noise(dt) for model in self.models], axis=-3)

    def mode_transition(self, dt: ArrayLike) -> Array:
        """Probabilities of mode j after ``dt`` seconds given mode i before: expm(generator dt), rows sum to one.

        With equal rates the exponential is closed: with ``e = exp(-dt r / ((r - 1) sojourn))`` the chain has become
        any other mode with probability ``(1 - e) / r`` each.

        Args:
            dt: intervals [s], shape (...), not negative.

        Returns:
            shape (..., r, r), [i, j] from i to j.
        """
        r = len(self.models)
        other = -np.expm1(-as_array(dt) * self._rate) / r
        eye = np.eye(r)
        off = np.asarray(other)[..., None, None]
        return eye * (1.0 - (r - 1) * off) + (1.0 - eye) * off


class Modes(NamedTuple):
    """A density in modes.

    Attributes:
        log_mu: logarithms of the probabilities of the modes, shape (..., r).
        densities: one Gaussian per mode, shapes (..., r, n), (..., r, n, n).
    """

    log_mu: Array
    densities: Gaussian

    @property
    def merged(self) -> Gaussian:
        """The one Gaussian with mean and covariance of all modes together, shapes (..., n), (..., n, n)."""
        return merge(self.log_mu, self.densities)


class FilteredModes(NamedTuple):
    """Modes after a scan.

    Attributes:
        modes: the posterior.
        log_p_bar: logarithm of the weight sum of all modes, shape (...).
    """

    modes: Modes
    log_p_bar: Array


def start(prior: Gaussian, imm: Imm) -> Modes:
    """A density whose mode is unknown: the prior in every mode, with the stationary probabilities.

    Args:
        prior: shapes (..., n), (..., n, n).
        imm: the models.

    Returns:
        the modes.
    """
    r = len(imm.models)
    log_mu = np.full((*prior.x.shape[:-1], r), -np.log(r))
    x, P = np.repeat(prior.x[..., None, :], r, axis=-2), np.repeat(prior.P[..., None, :, :], r, axis=-3)
    return Modes(log_mu, Gaussian(x, P))


def mix(mu: Array, densities: Gaussian, transition: Array) -> tuple[Array, Gaussian]:
    """The chain moves on: what the modes will be, and the density of each given that it will be that mode (Eq. 1a).

        mu'_j = sum_i mu_i Pi_ij          density'_j: moments of the densities i, with weights mu_i Pi_ij / mu'_j

    Args:
        mu: probabilities of the modes, shape (..., r); they need not sum to one.
        densities: one Gaussian per mode, shapes (..., r, n), (..., r, n, n).
        transition: probabilities from mode i to mode j, shape (..., r, r).

    Returns:
        the predicted probabilities mu', shape (..., r), and the mixed densities. A mode that cannot be (mu'_j = 0)
        keeps its own density.

    References:
        theory.md Eq. (1a); Bar-Shalom, Li & Kirubarajan §11.6.6, steps 1 and 2.
    """
    log_mu, mixed = mix_log(_log(mu), densities, transition)
    return np.exp(log_mu), mixed


def predict_probabilities(log_mu: Array, transition: Array) -> Array:
    """Log probabilities of the modes after a transition, shapes (..., r), (..., r, r) to (..., r) (Eq. 1a)."""
    return log_sum_exp(log_mu[..., None, :] + _log(transition.mT))


def mix_log(log_mu: Array, densities: Gaussian, transition: Array) -> tuple[Array, Gaussian]:
    """``mix`` with the logarithms of the probabilities, which then may be as small as they like."""
    # Axis -2 counts the mode that will be, -1 the mode that was.
    joint = log_mu[..., None, :] + _log(transition.mT)
    log_predicted = log_sum_exp(joint)
    possible = np.isfinite(log_predicted)[..., None]
    weights = np.exp(joint - np.where(possible, log_predicted[..., None], 0.0))
    weights = np.where(possible, weights, np.eye(log_mu.shape[-1]))
    x, P = densities
    return log_predicted, moments(weights, Gaussian(x[..., None, :, :], P[..., None, :, :, :]))


def predict_models(densities: Gaussian, imm: Imm, dt: Array, multiplicity: float = 1.0) -> Gaussian:
    """Every mode's density predicted by its own model.

    Args:
        densities: shapes (..., r, n), (..., r, n, n).
        imm: the models.
        dt: intervals [s], shape broadcast against the batch axes, those of the modes left out.
        multiplicity: factor on Q (Eq. 5): n_sensors for a factor of the product, 1 for an honest density.

    Returns:
        the predicted densities.
    """
    return predict(densities, imm.transitions(dt), multiplicity * imm.noises(dt))


def predict_modes(modes: Modes, imm: Imm, dt: Array, multiplicity: float = 1.0) -> Modes:
    """Mix, then predict by the models.

    Args:
        modes: of the last time.
        imm: the models.
        dt: intervals [s], shape broadcast against the batch axes.
        multiplicity: factor on Q.

    Returns:
        the predicted modes.
    """
    log_mu, mixed = mix_log(modes.log_mu, modes.densities, imm.mode_transition(dt))
    return Modes(log_mu, predict_models(mixed, imm, dt, multiplicity))


def predict_stationary(prior: Gaussian, imm: Imm, dt: Array, multiplicity: float = 1.0) -> Gaussian:
    """One Gaussian predicted by all models with the stationary probabilities, and merged by moments.

    Unlike the nominal model it has the spread of the models' predictions in its covariance, for the state at hand; two
    intervals do not make their sum.

    Args:
        prior: shapes (..., n), (..., n, n).
        imm: the models.
        dt: intervals [s], shape broadcast against the batch axes.
        multiplicity: factor on Q.

    Returns:
        the predicted densities.
    """
    modes = start(prior, imm)
    return merge(modes.log_mu, predict_models(modes.densities, imm, dt, multiplicity))


def merge(log_mu: Array, densities: Gaussian) -> Gaussian:
    """One Gaussian by moments from weights that may be tiny and need not sum to one.

    Args:
        log_mu: logarithms of the weights, shape (..., r), not all -inf.
        densities: shapes (..., r, n), (..., r, n, n).

    Returns:
        shapes (..., n), (..., n, n).
    """
    return moments(np.exp(log_mu - log_sum_exp(log_mu)[..., None]), densities)


def imm_pdaf(predicted: Modes, plots: Plots, sensor: Linearised, clutter: Clutter) -> FilteredModes:
    """One scan filtered by a PDAF in every mode, each with its own gate (Eq. 1b, 6, 7).

        p_bar = sum_r mu_r p_bar_r          mu_r <- mu_r p_bar_r / p_bar

    Args:
        predicted: from ``predict_modes``.
        plots: of the scan, shape (..., M, m): the same for all modes.
        sensor: linearised at the mean of every mode.
        clutter: detection probability, false plots, gate; shape (...): the same for all modes.

    Returns:
        the posterior and log p_bar. A scan that is impossible in every mode gives log p_bar = -inf and teaches
        nothing on the mode.

    References:
        theory.md Eq. (1b), (6), (7); Bar-Shalom, Li & Kirubarajan §11.6.6.
    """
    valid = None if plots.valid is None else plots.valid[..., None, :]
    per_mode = clutter._replace(p_d=clutter.p_d[..., None], log_rho_f=clutter.log_rho_f[..., None])
    densities, log_p_bar = pdaf(predicted.densities, Plots(plots.z[..., None, :, :], valid), sensor, per_mode)
    joint = predicted.log_mu + log_p_bar
    total = log_sum_exp(joint)
    possible = np.isfinite(total)[..., None]
    log_mu = np.where(possible, joint - np.where(possible, total[..., None], 0.0), predicted.log_mu)
    return FilteredModes(Modes(log_mu, densities), total)


def draw_path(motion: Motion, state: Array, intervals_s: Array, rng: np.random.Generator) -> Array:
    """The path of a target: its states at the ends of intervals that follow one another.

    A target of several models starts with any of them and changes at random instants, within the intervals too.

    Args:
        motion: the motion model.
        state: at the start of the first interval, shape (n,).
        intervals_s: not negative [s], shape (K,).
        rng: of everything random.

    Returns:
        states, shape (K, n).
    """
    models: tuple[Motion, ...] = motion.models if isinstance(motion, Imm) else (motion,)
    sojourn = motion.sojourn if isinstance(motion, Imm) else np.inf
    r, mode, until_change = len(models), 0, np.inf
    if r > 1:
        mode, until_change = int(rng.integers(r)), rng.exponential(sojourn)
    path = np.empty((len(intervals_s), motion.n))
    for k, interval in enumerate(intervals_s):
        left = interval
        while until_change < left:
            state, left = _move(models[mode], state, until_change, rng), left - until_change
            mode, until_change = (mode + int(rng.integers(1, r))) % r, rng.exponential(sojourn)
        state, until_change = _move(models[mode], state, left, rng), until_change - left
        path[k] = state
    return path


def _move(model: Motion, state: Array, seconds: float, rng: np.random.Generator) -> Array:
    dt = np.array(seconds)
    moved: Array = model.transition(dt) @ state + draw_noise(rng, model.noise(dt), 1)[0]
    return moved


def _log(probability: Array) -> Array:
    """Logarithm with log 0 = -inf and no warning."""
    return np.log(probability, out=np.full_like(probability, -np.inf), where=probability > 0.0)
