"""``waldnet.estimation``: the door to the filters and tests, its names, their docstrings, and plain lists."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from enum import Enum
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import waldnet
from waldnet import estimation as est
from waldnet.api_reference import make_reference

NAMES = """
    AllAround Ancestry Bearing Box Candidates Cluster ClusterTest Clutter Constant ConstantAcceleration ConstantVelocity
    CoordinatedTurn Detection Disc EXACT Everywhere Existence Expected Extractor FieldOfView Filtered FilteredModes
    Gaussian Generation Global Histories Imm JointHistories JointWeights Linearised Measurement Mixture Modes Motion
    Notch Plots Polar PolarDoppler Position Product Reduction Retrodicted Sector Sensor SensorPose SensorScan Share
    Status Swerling Thresholds Verdict View Visibility associate_jointly backward candidates cluster cumulative
    cumulative_rate decide decide_with_life descendants expect extract extract_cluster generation globalise histories
    imm_pdaf jpda kalman kalman_filter log_lambda log_pdf log_sum_exp merge_modes mixture_step mixture_step_traced
    moments nearest nearest_neighbour normalise pdaf predict predict_modes product revisit_interval seeds shrink smooth
    start_mixture start_modes survive thresholds together update
"""


def test_the_names_are_these() -> None:
    assert sorted(est.__all__) == sorted(NAMES.split())


# ---- docstrings


def described() -> Iterator[tuple[str, Any]]:
    for module in (waldnet, est):
        for name in module.__all__:
            value = getattr(module, name)
            if not isinstance(value, ModuleType | est.Reduction):
                yield f"{module.__name__}.{name}", value


def faults_of(name: str, value: Any) -> Iterator[str]:
    """What the docstring of a class or function lacks."""
    text = inspect.getdoc(value) or ""
    if not inspect.isclass(value):
        if "Args:" not in text and inspect.signature(value).parameters:
            yield f"{name}: its arguments are not described"
        if "Returns:" not in text and "Yields:" not in text:
            yield f"{name}: what it returns is not described"
        return
    fields = getattr(value, "_fields", None) or getattr(value, "__dataclass_fields__", {})
    section = text.partition("Attributes:\n")[2]
    told = {word.strip() for line in section.splitlines() for word in line.partition(":")[0].split(",")}
    yield from (f"{name}.{field}: is not described" for field in sorted(set(fields) - told))
    if not text or (issubclass(value, Enum) and text == inspect.getdoc(Enum)):
        yield f"{name}: has no docstring"
    for part, member in vars(value).items():
        function = getattr(member, "__func__", member)
        public = not part.startswith("_") and (isinstance(member, property) or inspect.isfunction(function))
        if public and not inspect.getdoc(function):
            yield f"{name}.{part}: has no docstring"


def test_every_name_is_described() -> None:
    assert [fault for name, value in described() for fault in faults_of(name, value)] == []


def test_arrays_are_described_with_their_shapes() -> None:
    """Of functions that take or give arrays, and of classes that hold some."""
    without = []
    for name, value in described():
        if isinstance(value, type) and issubclass(value, Exception | Enum):
            continue
        annotations = {**getattr(value, "__annotations__", {})}
        for base in getattr(value, "__mro__", ())[1:2]:
            annotations.update(vars(base).get("__annotations__", {}))
        arrays = any("Array" in str(kind) or "Gaussian" in str(kind) for kind in annotations.values())
        if arrays and name != "waldnet.columns" and "shape" not in (inspect.getdoc(value) or ""):
            without.append(name)
    assert without == []


def test_the_reference_is_that_of_the_docstrings() -> None:
    """If not: python -m waldnet.api_reference docs/reference/api.md."""
    page = Path(__file__).parent.parent / "docs/reference/api.md"
    assert page.read_text(encoding="utf-8") == make_reference()
    for name, _ in described():
        assert f"### {name}\n" in page.read_text(encoding="utf-8")


# ---- plain numbers and lists


@pytest.mark.parametrize(
    "motion",
    [
        est.ConstantVelocity(2, 3.0),
        est.ConstantAcceleration(3, 0.5),
        est.CoordinatedTurn(2, 3.0, 0.1),
        est.Imm.of((est.ConstantVelocity(2, 3.0), est.CoordinatedTurn(2, 3.0, 0.1)), 20.0),
    ],
)
def test_a_time_may_be_a_plain_number_or_a_list(motion: est.Motion) -> None:
    for of in (motion.transition, motion.noise):
        one, several = of(2), of([1.0, 2.0])
        np.testing.assert_array_equal(one, of(np.array(2.0)))
        np.testing.assert_array_equal(several, of(np.array([1.0, 2.0])))
        np.testing.assert_array_equal(several[1], one)
        assert several.shape == (2, motion.n, motion.n)


MOTION = est.ConstantVelocity(2, 1.0)
SENSOR = est.Sensor(est.Position((4.0, 5.0), 4), 0.8, 3.0, est.Box((200.0, 200.0)))
CLUTTER = est.Clutter(0.8, SENSOR.log_rho_f, 1.0)
P = np.diag([30.0, 20.0, 4.0, 4.0])


def test_densities_plots_and_clutter_may_be_lists() -> None:
    prior, plots = est.Gaussian([1, 2, 3, 4], P.tolist()), est.Plots([[3, 4]])
    assert (prior.x.dtype, plots.z.dtype, plots.z.shape) == (np.float64, np.float64, (1, 2))
    linear = SENSOR.measurement.linearise(prior, np.zeros(2))
    ours = est.pdaf(prior, plots, linear, CLUTTER)
    arrays = est.Clutter(np.array(0.8), np.array(SENSOR.log_rho_f), 1.0)
    theirs = est.pdaf(
        est.Gaussian(np.array([1.0, 2.0, 3.0, 4.0]), P), est.Plots(np.array([[3.0, 4.0]])), linear, arrays
    )
    np.testing.assert_array_equal(ours.density.x, theirs.density.x)
    assert ours.log_p_bar == theirs.log_p_bar
    many = est.Gaussian(3 * [[1.0, 2.0, 3.0, 4.0]], 3 * [P])
    batch = est.pdaf(many, plots, SENSOR.measurement.linearise(many, np.zeros(2)), CLUTTER)
    np.testing.assert_allclose(batch.log_p_bar, 3 * [ours.log_p_bar])
    assert prior._replace(x=prior.x + 1.0).x[0] == 2.0


def test_the_test_takes_plain_numbers() -> None:
    limits = est.thresholds(1e-4, 0.95)
    verdict = est.decide([10.0, 0.0, -4.0], [0, 0, 0], limits)
    assert verdict.status.tolist() == [est.Status.CONFIRMED, est.Status.TENTATIVE, est.Status.DELETED]
    assert est.decide(10.0, 0, limits).accepted
    assert est.cumulative([0.5, 0.5]) == pytest.approx(0.75)
    assert est.revisit_interval([2.0, 2.0]) == 1.0


def test_plots_of_an_extraction_may_be_lists() -> None:
    scan = est.SensorScan(1.0, SENSOR, [0.0, 0.0], [0.0, 0.0], [[3.0, 4.0]])
    assert isinstance(scan.plots, est.Plots)
    start = est.candidates(np.array([0]), est.Gaussian([[[0.0, 0.0, 0.0, 0.0]]], [[P]]))
    (after,) = est.extract(est.Extractor(MOTION, est.thresholds(1e-4, 0.95), est.EXACT), start, 0.0, [scan])
    assert after.log_lr[0] > 0.0


# ---- filters of one call


def kalman_update(x: Any, z: Any) -> tuple[Any, Any]:
    """By the textbook."""
    H, R = np.eye(2, 4), np.diag([16.0, 25.0])
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return x + K @ (z - H @ x), (np.eye(4) - K @ H) @ P


def test_the_kalman_filter_takes_the_closest_plot_for_true() -> None:
    prior = est.Gaussian([1.0, 2.0, 3.0, 4.0], P)
    linear = SENSOR.measurement.linearise(prior, np.zeros(2))
    x, after = kalman_update(prior.x, [3.0, 4.0])
    for step in (est.kalman_filter, est.nearest_neighbour):
        density = step(prior, est.Plots([[90.0, 4.0], [3.0, 4.0]]), linear, CLUTTER).density
        np.testing.assert_allclose(density.x, x)
        np.testing.assert_allclose(density.P, after)
    # A plot that is hardly the target's: to the Kalman filter it is, to the nearest neighbour it was missed.
    far = est.Plots([[40.0, 2.0]])
    np.testing.assert_allclose(
        est.kalman_filter(prior, far, linear, CLUTTER).density.x, kalman_update(prior.x, far.z[0])[0]
    )
    np.testing.assert_allclose(est.nearest_neighbour(prior, far, linear, CLUTTER).density.x, prior.x)
    none = est.kalman_filter(prior, est.Plots(np.empty((0, 2))), linear, CLUTTER)
    np.testing.assert_allclose(none.density.x, prior.x)


def test_jpda_is_the_sum_over_all_ways_to_share_the_plots() -> None:
    """Two tracks close together and two plots: enumerated, the tracks surely there and not."""
    x = np.array([[0.0, 0.0, 1.0, 0.0], [8.0, 3.0, 0.0, 1.0]])
    prior, z = est.Gaussian(x, [P, P]), np.array([[4.0, 2.0], [9.0, -1.0]])
    S = np.diag([46.0, 45.0])
    rho_f = np.exp(SENSOR.log_rho_f)
    w = np.array([[0.2, *(0.8 * multivariate_normal(m[:2], S).pdf(z) / rho_f)] for m in x])
    for existence in (1.0, [0.9, 0.4]):
        r = np.broadcast_to(existence, 2)
        linear = SENSOR.measurement.linearise(prior, np.zeros(2))
        filtered = est.jpda(prior, est.Plots(z), linear, CLUTTER, existence)
        # Chances of every plot of track 0, whatever track 1, which may not exist, does.
        chances = np.zeros(3)
        for j, k in product(range(3), range(3)):
            if j == 0 or j != k:
                chances[j] += w[0, j] * (r[1] * w[1, k] + (1.0 - r[1]) * (k == 0))
        chances /= chances.sum()
        updated = [x[0], *(kalman_update(x[0], plot)[0] for plot in z)]
        np.testing.assert_allclose(filtered.density.x[0], chances @ np.array(updated), rtol=1e-9)


def test_jpda_of_tracks_far_apart_is_pdaf() -> None:
    x = np.array([[0.0, 0.0, 1.0, 0.0], [5e3, 0.0, 0.0, 1.0]])
    prior, plots = est.Gaussian(x, [P, P]), est.Plots([[4.0, 2.0], [5e3, -1.0], [5e3, 4.0]])
    linear, gated = SENSOR.measurement.linearise(prior, np.zeros(2)), CLUTTER._replace(p_g=0.999)
    alone, shared = (step(prior, plots, linear, gated) for step in (est.pdaf, est.jpda))
    np.testing.assert_allclose(shared.density.x, alone.density.x)
    np.testing.assert_allclose(shared.density.P, alone.density.P)
    np.testing.assert_allclose(shared.log_p_bar, alone.log_p_bar)
