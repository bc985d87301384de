"""Joyride with settings that one half of the recording suggests, judged on either half: docs/real-runs.md.

    python -m waldnet.benchmarks.real_halves

Noise, p_d and false plots are what ``scenarios.joyride.measure`` measures on a half. Of some values of psd the one with
the smallest GOSPA there is taken. Each network tracks the whole recording.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import Any

from waldnet.benchmarks.real_truth import rules_of, times_of, truth_of
from waldnet.common.config import Scenario, load_scenario
from waldnet.common.messages import Tracks
from waldnet.evaluation.evaluation import judge
from waldnet.evaluation.paths import targets_at
from waldnet.evaluation.runs import run_of
from waldnet.evaluation.table import said
from waldnet.offline.replay import Replay
from waldnet.scenarios.catalogue import FOLDER, find
from waldnet.scenarios.joyride.measure import compare, parts, settings
from waldnet.sensor_node.sources import all_scans

PSDS = (0.3, 1.0, 3.0, 10.0, 30.0)
_FORMS = ("{gospa_m[total]:.1f}", "{held_share:.1%}", "{breaks}", "{false_tracks}", "{rmse_m:.1f}")
_NAMES = ("GOSPA [m]", "held", "breaks", "false tracks", "RMSE [m]")


def changed(scenario: Scenario, psd: float, measured: Mapping[str, Any]) -> Scenario:
    """The scenario with another psd, and with what was measured of its only sensor."""
    (sensor,) = scenario.sensors
    motion = scenario.motion.model_copy(update={"psd": psd})
    return scenario.model_copy(update={"motion": motion, "sensors": (sensor.model_copy(update=measured),)})


def judged(scenario: Scenario, halves: Mapping[str, tuple[float, float]]) -> dict[str, dict[str, Any]]:
    """What is found of a scenario in each half.

    Args:
        scenario: to track.
        halves: first and last time of each [s].
    """
    scans, known, rules = all_scans(scenario), truth_of(scenario), rules_of(scenario)
    pictures = [message for message in Replay(scenario, scans).run() if isinstance(message, Tracks)]
    run, times_s = run_of("halves", pictures, scenario, scenario.motion.dimensions), times_of(scenario, scans, known)
    found = {}
    for half, (first_s, last_s) in halves.items():
        at_s = times_s[(times_s >= first_s) & (times_s <= last_s)]
        targets = targets_at(known, at_s, rules.gap_s, scenario.motion.dimensions)
        found[half] = judge(run, targets, at_s, rules).summary()
    return found


def table() -> Iterator[str]:
    """A row for each half that settings are from, and for each half that is judged."""
    scenario = load_scenario(find("joyride"))
    seen = {name: part for name, part in parts(compare(FOLDER / "joyride")).items() if name != "all"}
    halves = {name: (float(part.times_s[0]), float(part.times_s[-1])) for name, part in seen.items()}
    yield f"| settings from | psd | judged on | {' | '.join(_NAMES)} |"
    yield "|---|---:|---" + "|---:" * len(_NAMES) + "|"
    for half, part in seen.items():
        print(half, file=sys.stderr)
        tried = {psd: judged(changed(scenario, psd, settings(part)), halves) for psd in PSDS}
        best = min(tried, key=lambda psd, half=half: tried[psd][half]["gospa_m"]["total"])  # type: ignore[misc]
        for other, summary in tried[best].items():
            yield f"| {half} | {best:g} | {other} | {' | '.join(said(form, summary) for form in _FORMS)} |"


if __name__ == "__main__":
    print(*table(), sep="\n")
