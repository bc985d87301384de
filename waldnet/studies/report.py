"""Report of a study: one HTML file with tables and figures that needs nothing else, and the figures as files."""

from __future__ import annotations

import io
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.figure import Figure

from waldnet.common.files import write_atomically
from waldnet.evaluation.style import SETTINGS, look
from waldnet.studies.plan import Variant
from waldnet.studies.progress import figure as words
from waldnet.studies.report_figures import (
    Scene,
    draw_accuracy,
    draw_calibration,
    draw_decided,
    draw_log_lr,
    draw_overview,
    draw_thresholds,
)
from waldnet.studies.report_frontier import draw_frontier
from waldnet.studies.study import Outcome, Study
from waldnet.studies.tables import Table, rows_of


class Sheet(NamedTuple):
    """A figure of the report.

    Attributes:
        name: of its files.
        title: in the report.
        caption: how to read it.
        draw: draws it.
        needs: whether it is of variants with a target (True), without (False), or of all (None).
    """

    name: str
    title: str
    caption: str
    draw: Callable[[Scene], Figure]
    needs: bool | None = None


SHEETS = (
    Sheet(
        "frontier",
        "Performance against bandwidth",
        "Each marker is a mode. Bytes are payload of one sensor for one track and scan, up-link plus down-link. "
        "Decision length counts wrong decisions too: see the share confirmed in the next figure.",
        draw_frontier,
        needs=True,
    ),
    Sheet(
        "overview",
        "Decisions, losses, bytes",
        "At the scenario's thresholds. Decision length is counted in measurement times of the network, over the runs "
        "that were decided; bars run from the 10 % to the 90 % quantile. Bars of shares are Clopper-Pearson bounds "
        "of 95 %.",
        draw_overview,
    ),
    Sheet(
        "log_lr",
        "Log LR",
        "Mean over all runs, nothing reset or deleted. Left: the stretch in which the test decides; right: all scans.",
        draw_log_lr,
    ),
    Sheet(
        "decided",
        "How soon runs are decided",
        "Share of the runs whose first decision has fallen, by kind.",
        draw_decided,
    ),
    Sheet(
        "thresholds",
        "Other thresholds",
        "The same runs under other pairs (p0, p1), Eq. (14). Right: share of runs decided wrongly, against what the "
        "thresholds promise; below the dotted line the promise is kept. Shares of 0 are not shown.",
        draw_thresholds,
    ),
    Sheet(
        "accuracy",
        "Accuracy",
        "RMSE and NEES of the runs that are not lost after the last scan. GOSPA of the operator's picture, all runs: "
        "the track is reported while it is confirmed, so GOSPA begins at the price of a missed target.",
        draw_accuracy,
        needs=True,
    ),
    Sheet(
        "calibration",
        "Calibration",
        "Share of the runs without a target in which the LR reached B before the scenario's end; shaded: "
        "Clopper-Pearson bounds of 95 %. For an exact LR the probability is at most 1/B (Ville), the grey line: a band "
        "that is all above it tells of an LR that is too sure. Dashed, where centralised-mht played with a target too: "
        "importance sampling, from runs with a target that count with the inverse of that mode's LR.",
        draw_calibration,
        needs=False,
    ),
)

_COLUMNS = (
    ("log LR", "log_lr_mean", "{:.2f}"),
    ("± s.e.", "log_lr_se", "{:.2f}"),
    ("confirmed", "p_confirmed", "{:.1%}"),
    ("deleted", "p_deleted", "{:.1%}"),
    ("undecided", "p_undecided", "{:.1%}"),
    ("scans to decide", "decision_scans_mean", "{:.2f}"),
    ("q10", "decision_scans_q10", "{:.0f}"),
    ("q50", "decision_scans_q50", "{:.0f}"),
    ("q90", "decision_scans_q90", "{:.0f}"),
    ("lost", "share_lost", "{:.1%}"),
    ("RMSE [m]", "rmse_m", "{:.1f}"),
    ("NEES", "nees_mean", "{:.2f}"),
    ("GOSPA [m]", "gospa_mean_m", "{:.1f}"),
    ("bytes up", "uplink_bytes", "{:.1f}"),
    ("bytes down", "downlink_bytes", "{:.1f}"),
)

_STYLE = """
:root { --ink: #1c1c1c; --quiet: #5a5a5a; --line: #dcdcdc; }
body { font: 15px/1.5 system-ui, "Helvetica Neue", Arial, sans-serif; color: var(--ink); background: #fff;
  max-width: 1240px; margin: 2.5rem auto; padding: 0 1.5rem; }
h1 { font-size: 1.7rem; margin: 0 0 .3rem; } h2 { font-size: 1.2rem; margin: 2.6rem 0 .3rem; }
h3 { font-size: 1rem; margin: 1.4rem 0 .3rem; }
p, figcaption { color: var(--quiet); max-width: 62rem; margin: .2rem 0 .8rem; }
code { background: #f4f4f4; padding: .1em .35em; border-radius: 3px; color: var(--ink); overflow-wrap: anywhere; }
figure { margin: 0; } figure svg { width: 100%; height: auto; }
.table { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13.5px; font-variant-numeric: tabular-nums; width: 100%; }
th { font-weight: 600; color: var(--quiet); text-align: right; padding: .3rem .5rem; }
th { border-bottom: 1px solid var(--line); }
td { text-align: right; padding: .22rem .5rem; border-bottom: 1px solid #f0f0f0; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
td i { display: inline-block; width: .7em; height: .7em; border-radius: 50%; margin-right: .5em; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1rem; margin: .8rem 0; }
dt { color: var(--quiet); } dd { margin: 0; }
@media print { body { max-width: none; margin: 0; } figure, table { break-inside: avoid; } }
"""


def write_report(study: Study, outcome: Outcome, command: Sequence[str]) -> Path:
    """Write the report and its figures.

    Args:
        study: what was done.
        outcome: its tables.
        command: words after ``waldnet`` that make it again.

    Returns:
        the HTML file.
    """
    folder = study.store.folder
    (folder / "figures").mkdir(exist_ok=True)
    scene = scene_of(study, outcome)
    kinds = set(scene.variants.values())
    body = [*_head(study, command), *_tables(study, outcome.summary)]
    for sheet in SHEETS:
        if sheet.needs is None or sheet.needs in kinds:
            svg = _draw(sheet, scene, folder / "figures")
            caption = f"<figcaption>{escape(sheet.caption)}</figcaption>"
            body.append(f'<h2 id="{sheet.name}">{escape(sheet.title)}</h2><figure>{caption}{svg}</figure>')
    title = escape(f"{study.scenario.name}: study")
    page = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head><body>\n'
        + "\n".join(body)
        + "\n</body></html>\n"
    )
    file = folder / "report.html"
    write_atomically(file, page.encode())
    return file


def scene_of(study: Study, outcome: Outcome) -> Scene:
    """What the figures of a study are of."""
    decision = study.scenario.decision
    return Scene(
        outcome=outcome,
        modes=study.order.modes,
        variants={variant.name: variant.has_target for variant in study.variants},
        p0=decision.p0,
        p1=decision.p1,
        limits=decision.thresholds,
        n=study.scenario.motion.build().n,
        twins={bare.name: twin.name for bare in study.variants for twin in study.variants if _twins(bare, twin)},
    )


def _twins(bare: Variant, twin: Variant) -> bool:
    """Whether two variants differ in the target only, which the first one lacks."""
    return twin.has_target and not bare.has_target and twin.scenario.sensors == bare.scenario.sensors


def _draw(sheet: Sheet, scene: Scene, folder: Path) -> str:
    """Write a figure as PNG and SVG.

    Returns:
        the SVG element.
    """
    svg = io.StringIO()
    # With a salt, the names of parts are the same every time.
    with mpl.rc_context({**SETTINGS, "svg.hashsalt": sheet.name}):
        drawn = sheet.draw(scene)
        for axes in drawn.axes:
            axes.minorticks_off()
        _lay_out(drawn)
        drawn.savefig(folder / f"{sheet.name}.png", dpi=110)
        drawn.savefig(svg, format="svg", metadata={"Date": None})
    text = svg.getvalue()
    write_atomically(folder / f"{sheet.name}.svg", text.encode())
    # Figures of one page must not share names of parts.
    return re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{sheet.name}-", text[text.index("<svg") :])


def _lay_out(figure: Figure) -> None:
    """Once: it takes most of the time, and every drawing would do it twice."""
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.execute(figure)
    figure.set_layout_engine("none")


def _head(study: Study, command: Sequence[str]) -> Iterator[str]:
    scenario, order = study.scenario, study.order
    limits = scenario.decision.thresholds
    yield f"<h1>{escape(scenario.name)}: modes side by side</h1>"
    yield f"<p><code>waldnet {escape(shlex.join(command))}</code></p>"
    yield _list(
        ("sensors", f"{len(scenario.sensors)}"),
        ("runs", f"{order.runs} per variant and mode; all modes on the same plots"),
        ("worlds", f"seeds {order.seed * 1_000_000} to {order.seed * 1_000_000 + order.runs - 1}"),
        (
            "thresholds",
            f"p0 = {scenario.decision.p0:g}, p1 = {scenario.decision.p1:g}: "
            f"log A = {limits.log_a:.2f}, log B = {limits.log_b:.2f}",
        ),
        ("lost", f"more than {scenario.study.lost_beyond:g} m from the truth after the last scan"),
        ("made by", f"waldnet {version('waldnet')}"),
    )


def _list(*entries: tuple[str, str]) -> str:
    return "<dl>" + "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in entries) + "</dl>"


def _tables(study: Study, summary: Table) -> Iterator[str]:
    yield "<h2>Summary</h2>"
    yield (
        "<p>All columns are in summary.csv, every run in runs.csv; "
        f"<code>waldnet simulate {escape(str(study.store.folder))}/variants/VARIANT.toml --seed WORLD_SEED</code> "
        "draws the plots of one again.</p>"
    )
    for variant in study.variants:
        rows = rows_of(summary, variant=variant.name)
        heads = _row("th", ["mode", *(heading for heading, _, _ in _COLUMNS)])
        lines = [_line({name: column[at] for name, column in rows.items()}) for at in range(len(rows["mode"]))]
        yield f'<h3>{escape(variant.name)}</h3><div class="table"><table>{heads}{"".join(lines)}</table></div>'


def _line(row: dict[str, Any]) -> str:
    mode = str(row["mode"])
    dot = f'<i style="background:{look(mode).colour}"></i>'
    cells = [f"{dot}{escape(mode)}", *(escape(words(row[column], form)) for _, column, form in _COLUMNS)]
    return _row("td", cells)


def _row(tag: str, cells: Iterable[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>"
