"""``waldnet evaluate``: recorded runs beside the truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from cyclopts import Parameter, validators

from waldnet.common.config import load_scenario
from waldnet.common.errors import EvaluationError
from waldnet.common.files import write_atomically

if TYPE_CHECKING:
    from waldnet.recording.inputs import Input

_INFINITE = float("inf")

#: Metres or seconds, more than none.
_Positive: TypeAlias = Annotated[float, Parameter(validator=validators.Number(gt=0.0, lt=_INFINITE))]
_Order: TypeAlias = Annotated[float, Parameter(validator=validators.Number(gte=1.0, lt=_INFINITE))]


def evaluate(
    run: Path,
    *others: Path,
    truth: Path,
    cutoff: _Positive = 100.0,
    order: _Order = 2.0,
    window: _Positive = 10.0,
    gap: _Positive = 5.0,
    centralised: bool = True,
    scenario: str | None = None,
    plots: Path | None = None,
    figure: Path | None = None,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Tell how well a recorded run found its targets: GOSPA, OSPA(2), confirmation, breaks, swaps, false tracks.

    Beside it stands what one tracker makes of the same plots: how well a network could do.

    Args:
        run: folder that waldnet run wrote, or file of what waldnet replay --json printed.
        others: further runs, to compare.
        truth: file of true positions (JSON Lines), such as waldnet simulate --truth writes.
        cutoff: farther from a target, a track is not of it [m].
        order: p of GOSPA and OSPA(2).
        window: of OSPA(2) [s].
        gap: positions of a target that are farther apart in time are not joined [s].
        centralised: put the centralised run of the same plots beside each run.
        scenario: of runs that keep no plots, such as files of lines: scenario file, or name of one that comes along.
        plots: with --scenario: recorded plots (JSON Lines) that these runs had instead of the scenario's.
        figure: PNG file to write, and a JSON file of the same name beside it; default: evaluation.png in the run's
            folder, comparison.png if there are several runs.
        as_json: print one JSON object, and nothing else.
    """
    from rich.console import Console

    from waldnet.evaluation.evaluation import Rules, judge
    from waldnet.evaluation.figure import draw
    from waldnet.evaluation.paths import judged_times, targets_at
    from waldnet.evaluation.runs import read_runs
    from waldnet.evaluation.table import show
    from waldnet.evaluation.yardstick import Beside, with_centralised
    from waldnet.scenarios.truth import read_truth

    rules = Rules(cutoff_m=cutoff, order=order, window_s=window, gap_s=gap)
    known = read_truth(truth)
    d = next((target.positions.shape[1] for target in known.values()), 2)
    paths, of = (run, *others), _input(scenario, plots, centralised=centralised)
    runs = read_runs(paths, d)
    beside = with_centralised(runs, paths, of, d) if centralised else Beside(runs, [])
    times_s = judged_times(known, beside.runs)
    targets = targets_at(known, times_s, gap, d)
    evaluations = [judge(one, targets, times_s, rules) for one in beside.runs]
    entry: dict[str, Any] = {
        "truth": str(truth),
        **rules._asdict(),
        "first_time": float(times_s[0]),
        "last_time": float(times_s[-1]),
        "without_centralised": beside.without,
        "runs": [evaluation.entry() for evaluation in evaluations],
    }
    text = json.dumps(entry, allow_nan=False)
    picture = figure or _default(run, several=bool(others))
    draw(evaluations, cutoff, window, picture)
    write_atomically(picture.with_suffix(".json"), f"{text}\n".encode())
    console = Console(highlight=False, markup=False)
    if as_json:
        console.out(text)
    else:
        show(console, evaluations, rules)
        for name in beside.without:
            why = "it keeps no plots; --scenario says where they come from"
            console.print(f"\n{name}: no centralised run beside it, for {why}", soft_wrap=True)
        console.print(f"\n{picture}, {picture.with_suffix('.json')}", soft_wrap=True)


def _input(scenario: str | None, plots: Path | None, *, centralised: bool) -> Input | None:
    """What the runs had to go on that do not keep it; None: not said."""
    from waldnet.recording.inputs import Input
    from waldnet.scenarios.catalogue import find
    from waldnet.sensor_node.sources import all_scans

    given = [option for option, value in (("--scenario", scenario), ("--plots", plots)) if value is not None]
    if given and not centralised:
        raise EvaluationError(f"{given[0]}: only the centralised run needs it, which --no-centralised leaves out")
    if scenario is None:
        if given:
            raise EvaluationError("--plots: says nothing without the scenario they are of: give --scenario too")
        return None
    loaded = load_scenario(find(scenario))
    return Input(loaded, all_scans(loaded, plots=plots))


def _default(run: Path, *, several: bool) -> Path:
    folder = run if run.is_dir() else run.parent
    return folder / ("comparison.png" if several else "evaluation.png")
