"""Builders that the tests of the mathematics share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from waldnet.common.estimation.gaussian import Array, Gaussian


@pytest.fixture(scope="session")
def draw() -> Callable[..., Gaussian]:
    """Random Gaussians with full covariances, eigenvalues from about 0.1 to 10 ``spread^2``."""

    def gaussians(rng: np.random.Generator, shape: tuple[int, ...], n: int, spread: float = 1.0) -> Gaussian:
        A = rng.normal(size=(*shape, n, n))
        P: Array = spread**2 * (A @ A.mT + 0.1 * np.eye(n))
        return Gaussian(spread * rng.normal(size=(*shape, n)), 0.5 * (P + P.mT))

    return gaussians
