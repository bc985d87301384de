"""The ``[initiation]`` table of a scenario file: how tracks start from plots that no track claims (theory.md §8)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np

from waldnet.common.estimation.gaussian import Array
from waldnet.common.quantities import Count, Duration, GateProbability, Model, NotNegative, Probability, Size


class InitiationConfig(Model):
    """How tracks start, and which are one.

    Attributes:
        plots: a track starts from one plot, or from two of any sensors.
        speed: standard deviation of each component of a target's velocity [m/s].
        acceleration: the same of its acceleration, where motion has one [m/s^2].
        min_speed: targets are faster [m/s]: the plots that a slower track claims are false ones to a clutter map.
        max_speed: no target is faster [m/s]; default: three times ``speed``.
        within: two plots that start a track lie no farther apart in time [s].
        claimed: a plot that belongs to the tracks with at least this probability starts none.
        gate: plots that are this surely not farther apart than two of one target start one track.
        merge: tracks whose states differ by less than this (squared Mahalanobis distance) are one; 0: none are.
        tentative: with so many tentative tracks no more start.
    """

    plots: Literal[1, 2] = 1
    speed: Size
    acceleration: Size = 1.0
    min_speed: NotNegative = 0.0
    max_speed: Size | None = None
    within: Duration = 5.0
    claimed: Probability = 0.5
    gate: GateProbability = 0.99
    merge: NotNegative = 0.5
    tentative: Count = 1000

    @property
    def fastest(self) -> float:
        """No target is faster [m/s]."""
        return 3.0 * self.speed if self.max_speed is None else self.max_speed

    def spread(self, n: int, d: int) -> Array:
        """Standard deviations of all but the position, shape (n - d,)."""
        return np.repeat([self.speed, self.acceleration], d)[: n - d]


def initiation_faults(initiation: object, window: Any, kinds: Sequence[Any]) -> Iterator[str]:
    """Faults between ``[initiation]``, the kinds of the sensors, and how long the center keeps reports."""
    if not isinstance(initiation, dict):
        return
    if kinds and all(kind == "bearing" for kind in kinds):
        yield "initiation: no sensor tells a position, so that no track can start; all are of kind 'bearing'"
    slowest, fastest = initiation.get("min_speed", 0.0), initiation.get("max_speed")
    if isinstance(slowest, int | float) and isinstance(fastest, int | float) and slowest >= fastest > 0.0:
        yield f"initiation.min_speed: {slowest:g} is not below max_speed, {fastest:g}"
    within = initiation.get("within", 0.0)
    if isinstance(within, int | float) and isinstance(window, int | float) and within > window:
        yield f"initiation.within: {within} s is longer than the {window} s (fusion.window) that reports are kept"
