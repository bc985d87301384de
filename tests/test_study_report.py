"""The report: every figure of it, whatever there is to show."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import study_fakes
from builders import scenario
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from waldnet.evaluation.style import look
from waldnet.studies.plan import Order
from waldnet.studies.report import SHEETS, Sheet, write_report
from waldnet.studies.report_figures import Scene
from waldnet.studies.report_frontier import spaced
from waldnet.studies.study import Study

PLOT = scenario(name="a.b")


def report_of(folder: Path, order: Order, plot: Any = PLOT, command: tuple[str, ...] = ()) -> str:
    study = Study(plot, order, folder)
    study.play(1, None, lambda _: None)
    return write_report(study, study.judge(), command).read_text()


def titles(page: str) -> list[str]:
    return re.findall(r'<h2 id="(\w+)">', page)


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    study_fakes.take_over(monkeypatch)


def test_the_report_has_all_figures_and_needs_nothing_else(fakes: None, tmp_path: Path) -> None:
    order = Order(("centralised", "naive", "decentralised-decisions"), runs=8, seed=1, no_target=True)
    page = report_of(tmp_path / "s", order, command=("study", "a&b.toml", "--out", "two words"))
    assert titles(page) == [sheet.name for sheet in SHEETS]
    assert "waldnet study &#x27;a&amp;b.toml&#x27; --out &#x27;two words&#x27;" in page
    assert page.count("<svg") == len(SHEETS)
    assert not re.findall(r'(?:src|href)="(?!#)[^"]*"', page.replace("xlink:href", "href"))
    ids = re.findall(r' id="([^"]+)"', page)
    shared = {name for name in re.findall(r"#([\w-]+)\)|href=\"#([\w-]+)\"", page) for name in name if name}
    assert shared <= set(ids)
    assert not [name for name in shared if ids.count(name) > 1]
    for sheet in SHEETS:
        assert (tmp_path / f"s/figures/{sheet.name}.png").read_bytes().startswith(b"\x89PNG")


def test_the_report_is_the_same_every_time(fakes: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("waldnet.studies.report.SHEETS", SHEETS[:1])
    order = Order(("naive",), runs=3, seed=1)
    assert report_of(tmp_path / "s", order) == report_of(tmp_path / "s", order)


def test_without_a_target_there_is_no_accuracy_and_without_the_rest_no_calibration(
    fakes: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("waldnet.studies.report._draw", lambda *_: "")
    order = Order(("naive", "dkf"), runs=3, seed=1, p_d=(0.9, 0.5))
    without = titles(report_of(tmp_path / "without", order, scenario(target=[])))
    assert without == ["overview", "log_lr", "decided", "thresholds", "calibration"]
    assert "calibration" not in titles(report_of(tmp_path / "with", order))


@pytest.mark.parametrize("case", ["undecided", "impossible", "silent", "one run"])
def test_what_there_is_nothing_of_is_not_drawn(
    fakes: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    def play(plot: Any, mode: str, worlds: Any) -> Any:
        course = study_fakes.play(plot, mode, worlds)
        return {
            "undecided": course._replace(log_lr=np.zeros_like(course.log_lr)),
            "impossible": course._replace(log_lr=np.full_like(course.log_lr, -np.inf)),
            "silent": course._replace(uplink_bytes=0.0, downlink_bytes=0.0),
            "one run": course,
        }[case]

    def draw(sheet: Sheet, scene: Scene, _: Path) -> str:
        figure = sheet.draw(scene)
        figure.draw_without_rendering()
        return ""

    monkeypatch.setattr("waldnet.studies.modes.play", play)
    monkeypatch.setattr("waldnet.studies.report._draw", draw)
    order = Order(("centralised", "naive"), runs=1 if case == "one run" else 4, seed=1, no_target=True)
    assert titles(report_of(tmp_path / "s", order)) == [sheet.name for sheet in SHEETS]


def test_every_mode_looks_different_and_always_the_same() -> None:
    looks = [look(mode) for mode in study_fakes.MODES]
    assert len({(one.colour, str(one.line), one.marker) for one in looks}) == len(looks)
    assert look("unheard-of") == look("unheard-of")


@given(arrays(np.float64, st.integers(1, 20), elements=st.floats(-50, 250)), st.floats(1, 30))
def test_labels_keep_their_order_and_their_distance(wanted: Any, gap: float) -> None:
    wanted, height = np.sort(wanted), 200.0
    places = spaced(wanted, gap, height)
    assert (np.diff(places) >= min(gap, height / max(len(wanted) - 1, 1)) - 1e-6).all()
    assert places[0] >= -1e-6
    assert places[-1] <= height + 1e-6


def test_labels_that_have_room_stay_where_they_are() -> None:
    np.testing.assert_allclose(spaced(np.array([10.0, 50.0, 120.0]), 10.0, 200.0), [10.0, 50.0, 120.0])
    np.testing.assert_allclose(spaced(np.array([50.0, 50.0]), 10.0, 200.0), [45.0, 55.0])
