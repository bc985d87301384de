"""The ``[life]`` table of a scenario file: how long tracks last that nobody sees (theory.md §7)."""

from __future__ import annotations

from waldnet.common.quantities import Duration, InnerProbability, Model, Size


class LifeConfig(Model):
    """How tracks end that no sensor sees, and when confirmed ones count as coasting.

    Attributes:
        stay: mean time that targets stay [s]; default: as long as a slow one, of a quarter of ``initiation.speed``,
            takes through the largest field of view; without that speed, for ever.
        coasting_after: without a plot for so long, a confirmed track is coasting [s]; default: for the longest of the
            sensors that should see it, as many scans as it misses in a row once in 100,000 times (five at p_d =
            0.9), or its ``visibility.hidden_for`` if that is longer.
        lost_after: without a plot for so long, a track is lost as soon as no sensor can see it or its position is not
            known [s]; default: five scans of the slowest sensor, or five turns if it turns.
        lost_below: no sensor can see a track that lies in any field of view with less than this probability.
        lost_sigma: a position with a larger standard deviation is not known [m]; default: a quarter of the largest
            field of view.
    """

    stay: Duration | None = None
    coasting_after: Duration | None = None
    lost_after: Duration | None = None
    lost_below: InnerProbability = 0.05
    lost_sigma: Size | None = None
