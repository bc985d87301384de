"""Networks of any size for benchmarks: every track has a target, on a grid so wide that no two share plots."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import ceil, sqrt
from typing import Self

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import Scan

_SPACING_M = 1000.0
_SIGMA_M = 50.0
_P_D = 0.9


@dataclass(frozen=True)
class World:
    """A network and what it sees.

    Attributes:
        tracks: and targets, one each.
        sensors: of position, all alike, all scanning at the same instants.
        false_plots: mean per sensor and scan.
        interval_s: between scans.
        scans: of every sensor.
        precision: of reports.
    """

    tracks: int
    sensors: int
    false_plots: float = 5.0
    interval_s: float = 0.1
    scans: int = 100
    precision: str = "float64"

    @classmethod
    def of(cls, text: str) -> Self:
        """The world that ``str(world)`` describes, for processes that are told on their command line."""
        return cls(**{key: type(getattr(cls(1, 1), key))(value) for key, value in _pairs(text)})

    def __str__(self) -> str:
        """All attributes, as ``tracks=1,sensors=4,...``."""
        return ",".join(f"{key}={value}" for key, value in asdict(self).items())

    @property
    def extent_m(self) -> float:
        """Side length of the square that all sensors see."""
        # Targets stray from the grid while the benchmark runs.
        return _SPACING_M * ceil(sqrt(self.tracks)) + 20_000.0

    def scenario(self) -> Scenario:
        """The network."""
        view = {"shape": "box", "center": [0.0, 0.0], "size": [self.extent_m, self.extent_m]}
        sensor = {"sigma": [_SIGMA_M, _SIGMA_M], "p_d": _P_D, "false_plots": self.false_plots, "field_of_view": view}
        states = self.states()
        return Scenario.model_validate(
            {
                "name": "bench",
                "network": {"name": "bench"},
                "motion": {"psd": 1.0},
                "fusion": {"precision": self.precision},
                "sensor": [{"name": name, "scan_interval": self.interval_s, **sensor} for name in self.sensor_names],
                "hypothesis": [{"state": state.tolist(), "sigma": [100.0, 100.0, 20.0, 20.0]} for state in states],
            }
        )

    @property
    def sensor_names(self) -> list[str]:
        """Names of the sensors."""
        return [f"radar-{number}" for number in range(self.sensors)]

    def states(self) -> Array:
        """Where the targets start, shape (tracks, 4)."""
        side = ceil(sqrt(self.tracks))
        place = np.arange(self.tracks)
        grid = np.stack([place % side, place // side], axis=-1) - 0.5 * (side - 1)
        velocity = np.random.default_rng(1).normal(0.0, 15.0, (self.tracks, 2))
        return np.concatenate([_SPACING_M * grid, velocity], axis=-1)

    def seen_by(self, name: str) -> list[Scan]:
        """All scans of a sensor: targets fly straight on, detected at random."""
        rng = np.random.default_rng([2, *name.encode()])
        start, scenario = self.states(), self.scenario()
        scans = []
        for number in range(1, self.scans + 1):
            time_s = number * self.interval_s
            there = start[rng.random(self.tracks) < _P_D]
            plots = there[:, :2] + time_s * there[:, 2:] + rng.normal(0.0, _SIGMA_M, (len(there), 2))
            false = rng.uniform(-0.5, 0.5, (rng.poisson(self.false_plots), 2)) * self.extent_m
            z = rng.permutation(np.concatenate([plots, false]))
            scans.append(Scan(name, scenario.to_ns(time_s), np.zeros(2), z))
        return scans


def _pairs(text: str) -> list[tuple[str, str]]:
    return [(key, value) for key, _, value in (pair.partition("=") for pair in text.split(","))]
