"""What ``waldnet check`` prints, and what other commands say of a recording that does not fit."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import wrap
from warnings import catch_warnings, simplefilter

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.errors import PlotsWarning
from waldnet.common.messages import Scan
from waldnet.scenarios.plots import read_plots
from waldnet.scenarios.pose_check import pose_findings
from waldnet.scenarios.recording_check import SensorSummary, recording_findings, summarise
from waldnet.scenarios.scenario_check import Finding, scenario_findings
from waldnet.sensor_node.sources import spaced

#: So many findings are said by commands that do something else.
_WORST = 3
_WIDTH = 120
_HEAD = ("sensor", "scans", "from s", "to s", "interval s", "plots/scan", "empty", "outside view", "repeated")


def findings(scenario: Scenario, scans: Sequence[Scan] = ()) -> list[Finding]:
    """Everything that does not fit in a scenario and its recorded scans, what spoils results first."""
    found = scenario_findings(scenario, scans)
    if scans:
        found += [*recording_findings(scenario, spaced(scans, scenario)), *pose_findings(scenario, scans)]
    return sorted(found, key=lambda finding: not finding.spoils)


def read_recording(path: Path, scenario: Scenario) -> tuple[list[Scan], list[Finding]]:
    """The scans of a file of recorded plots, by time, and the lines of it that may be read wrongly.

    Raises:
        PlotsError: when the file is wrong.
    """
    with catch_warnings(record=True) as caught:
        simplefilter("always", PlotsWarning)
        scans = read_plots(path, scenario)
    doubts = (str(warning.message).partition(": ") for warning in caught)
    return scans, [Finding(where, text) for where, _, text in doubts]


def recording_table(scenario: Scenario, scans: Sequence[Scan]) -> Iterator[str]:
    """Lines of a table: what a recording has of each sensor, beside what the scenario expects."""
    rows = [_HEAD, *map(_row, summarise(scenario, scans), scenario.sensors)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEAD))]
    for row in rows:
        cells = (cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))
        yield "  ".join([row[0].ljust(widths[0]), *cells])


def _row(summary: SensorSummary, config: SensorConfig) -> tuple[str, ...]:
    if not summary.scans:
        return (summary.name, "0", *["-"] * (len(_HEAD) - 2))
    return (
        summary.name,
        str(summary.scans),
        f"{summary.first_s:.10g}",
        f"{summary.last_s:.10g}",
        f"{summary.interval_s:.3g} ({config.scan_interval:g})",
        f"{summary.plots_per_scan:.3g} ({config.false_plots:g} + {config.p_d or 1.0:g} per target)",
        *(f"{share:.1%}" for share in (summary.empty, summary.outside, summary.repeated)),
    )


def describe(found: Sequence[Finding]) -> Iterator[str]:
    """Lines that say what does not fit."""
    for finding in found:
        kind = "warning" if finding.spoils else "note"
        yield from wrap(f"{kind}: {finding}", _WIDTH, subsequent_indent="  ", break_long_words=False)


def warn(scenario: Scenario, scans: Sequence[Scan], recording: Path | None) -> None:
    """Say on standard error the worst of what does not fit, if results are wrong because of it.

    Args:
        scenario: the scenario.
        scans: that are used, by time.
        recording: where they come from; None: they are simulated.
    """
    found = [finding for finding in findings(scenario, scans if recording else ()) if finding.spoils]
    worst = list({finding.text: finding for finding in found}.values())[:_WORST]
    for line in describe(worst):
        sys.stderr.write(line + "\n")
    if found:
        others = f"{len(found) - len(worst)} more: " if len(found) > len(worst) else ""
        sys.stderr.write(f"{others}see waldnet check\n")
