"""Where the targets of recorded scenarios truly were, and when runs are judged by it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.errors import TruthError
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import Scan
from waldnet.evaluation.evaluation import Rules
from waldnet.scenarios.truth import Whereabouts, read_truth
from waldnet.scenarios.world import truth
from waldnet.sensor_node.sources import seed_of

#: Beyond it a track is no target's, by families of scenarios [m].
_CUTOFFS_M = {"autoferry": 30.0, "joyride": 50.0}


def truth_of(scenario: Scenario) -> dict[int, Whereabouts]:
    """The truth beside a scenario's recording, or that of its simulated world.

    Raises:
        TruthError: when there is none.
    """
    if scenario.recording is not None:
        plots = scenario.recording.plots
        return read_truth(plots.with_name(f"{plots.stem}-truth.jsonl"), (scenario.motion.dimensions,))
    if scenario.simulation is None:
        raise TruthError(f"{scenario.name}: has neither [recording] nor [simulation], so no truth")
    world = truth(scenario, seed_of(scenario, None))
    times_s = np.array([scenario.to_seconds(int(t_ns)) for t_ns in world.times_ns])
    places = world.x[..., : scenario.motion.dimensions]
    there = np.atleast_2d(np.isfinite(places).all(axis=-1))
    return {
        number: Whereabouts(times_s[there[number]], places[number, there[number]])
        for number in np.flatnonzero(there.any(axis=-1)).tolist()
    }


def rules_of(scenario: Scenario) -> Rules:
    """How runs are judged: a ferry's radar and lidar are sharper than a ship's radar, and that than coastal ones."""
    return Rules(cutoff_m=next((found for name, found in _CUTOFFS_M.items() if scenario.name.startswith(name)), 100.0))


def times_of(scenario: Scenario, scans: Sequence[Scan], known: dict[int, Whereabouts]) -> Array:
    """The times of all scans, from the first to the last point of the truth [s]."""
    first_s = min(target.times_s[0] for target in known.values())
    last_s = max(target.times_s[-1] for target in known.values())
    times_s: Array = np.unique(np.array([scenario.to_seconds(scan.time_ns) for scan in scans]))
    judged: Array = times_s[(times_s >= first_s) & (times_s <= last_s)]
    return judged
