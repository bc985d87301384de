"""The figure of negative information: what it shows is true, and the command of theory.md writes it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from waldnet.common.estimation.gaussian import Array
from waldnet.studies.notch import _PRIOR, _SOUTH, _WEST, Look, exact, worked_in

NOTHING, HERE = np.empty((0, 2)), np.zeros((1, 2))


def moments(looks: list[Look]) -> tuple[Array, Array]:
    """Mean and covariance of the velocity on a grid of 0.1 m/s."""
    side = np.arange(-40.0, 45.0, 0.1)
    grid = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1)
    density = exact(grid, looks)
    density /= density.sum()
    mean = np.einsum("ij,ijk->k", density, grid)
    return mean, np.einsum("ij,ijk,ijl->kl", density, grid - mean, grid - mean)


@pytest.mark.parametrize(
    "looks",
    [
        [Look(_WEST, NOTHING)],
        [Look(_SOUTH, NOTHING)],
        [Look(_WEST, NOTHING), Look(_SOUTH, NOTHING)],
        [Look(_WEST, HERE)],
    ],
)
def test_the_ellipses_are_those_of_the_exact_density(looks: list[Look]) -> None:
    """To 0.2 m/s: after two misses the first density was a mixture already, which the filter merged."""
    density = _PRIOR
    for look in looks:
        density = worked_in(density, look)
    mean, covariance = moments(looks)
    np.testing.assert_allclose(density.x[2:], mean, rtol=0.0, atol=0.2)
    np.testing.assert_allclose(
        np.sqrt(np.linalg.eigvalsh(density.P[2:, 2:])), np.sqrt(np.linalg.eigvalsh(covariance)), atol=0.2
    )


def test_the_command_writes_the_figure(tmp_path: Path) -> None:
    path = tmp_path / "notch.png"
    subprocess.run([sys.executable, "-m", "waldnet.studies.notch", path], check=True)
    assert path.read_bytes().startswith(b"\x89PNG")
