"""Targets that a sensor loses for a while: shadowed, hidden, overlooked, until they are seen again (theory.md §10).

Misses come in rows. To a sensor a target is visible or hidden, a Markov chain of two states: while visible it is
detected with p_d, while hidden never. A track carries the probability v of being visible, one per sensor. With it p_d
is v p_d in Eq. (6), and what the scan tells of v is Bayes' rule on the same weight sum. So a row of misses says more
and more that the target is hidden, and less and less that it does not exist.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array, BoolArray


class Visibility(NamedTuple):
    """How long targets stay visible and hidden on average.

    Attributes:
        visible_s: mean time until a visible target is hidden [s].
        hidden_s: mean time until a hidden target is visible [s].
    """

    visible_s: float
    hidden_s: float

    @property
    def share(self) -> float:
        """Of the time that targets are visible: what is known of a new track."""
        return self.visible_s / (self.visible_s + self.hidden_s)

    def predict(self, v: Array, dt: Array) -> Array:
        """Probability of being visible after the time ``dt`` [s], shapes that broadcast."""
        left = np.exp(-dt * (1.0 / self.visible_s + 1.0 / self.hidden_s))
        predicted: Array = self.share + (v - self.share) * left
        return predicted

    def draw(self, rng: np.random.Generator, dt: Array) -> BoolArray:
        """Draw whether one target is visible at times that lie ``dt`` [s] apart, shape (K,) to (K + 1,)."""
        chance = rng.random(1 + len(dt))
        visible = [bool(chance[0] < self.share)]
        for step, below in zip(dt, chance[1:], strict=True):
            visible.append(bool(below < self.predict(np.array(visible[-1], float), step)))
        return np.array(visible)


def seen(v: Array, log_p_bar: Array) -> Array:
    """Probability of being visible after a scan (Bayes' rule).

    A hidden target changes the likelihood ratio by the factor 1, whatever the plots.

    Args:
        v: probability before, shape (...).
        log_p_bar: log of the weight sum of the scan, computed with v p_d (Eq. 6), shape (...).

    References:
        Musicki, Evans & Stankovic, Integrated probabilistic data association (1994), Markov chain two.
    """
    with np.errstate(over="ignore"):  # what was impossible tells nothing
        hidden = (1.0 - v) * np.exp(-log_p_bar)
    return np.where(np.isfinite(hidden), np.clip(1.0 - hidden, 0.0, 1.0), v)
