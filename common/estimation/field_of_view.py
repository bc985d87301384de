"""Fields of view: where a sensor sees, how large that is, and how probably a track lies inside.

The probability that a Gaussian position lies inside is found in three steps, each for what the one before left over:

1. Inside or outside by ``CERTAIN`` sigmas: exactly 1 or 0. A track amid the field of view costs no more than this.
2. Closed form: a straight edge (ndtr) and a corner with correlation (Owen's T).
3. Adaptive quadrature: the round edge of a disc, and corners of a box in 3-D whose three axes are correlated.

Largest absolute errors measured, axis ratios of the covariance up to 100:

- box in 2-D: 1e-14 (SciPy's distribution function), sigmas of 0.01 to 30 half sides;
- disc 4e-10, ball 3e-9 (noncentral chi-square, dense quadrature), sigmas of 1e-4 to 10 radii;
- box in 3-D: 3e-10 (dense quadrature, finer tolerance), sigmas of 0.03 to 50 sides; 1e-7 at an axis ratio of 10,000.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from scipy.special import gamma, owens_t

from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian
from waldnet.common.estimation.quadrature import CERTAIN, Indices, decide, integrate, interval, normal

# In radii. An edge is known to 16 digits, and a sigma must keep more of them than the tolerance asks for, or bisection
# chases noise. The floor also mends the variance of a needle's narrow axis where rounding made it negative.
_SIGMA_MIN = 1e-7
# |rho| = 1 is no density; the next number below is one.
_RHO_MAX = float(np.nextafter(1.0, 0.0))


class FieldOfView(Protocol):
    """Where a sensor sees, relative to a center: a fixed point, or the sensor's own position."""

    @property
    def volume(self) -> float:
        """Area [m^2] in 2-D, volume [m^3] in 3-D."""
        ...

    def turned(self, heading: float) -> FieldOfView:
        """The field of view of a platform with this heading [rad], clockwise from north, of one that headed north."""
        ...

    def swept(self, left: float, right: float) -> FieldOfView:
        """What it passes over, or more, as its platform turns so far to the left and to the right [rad], both >= 0."""
        ...

    def contains(self, z: Array, center: Array) -> BoolArray:
        """Whether points lie inside, the edge included.

        Args:
            z: points [m], shape (..., d).
            center: of the field of view [m], shape (..., d), broadcast against ``z``.

        Returns:
            shape (...).
        """
        ...

    def probability_inside(self, position: Gaussian, center: Array) -> Array:
        """Probability that Gaussian positions lie inside.

        Args:
            position: means [m] and covariances [m^2], shapes (..., d), (..., d, d).
            center: of the field of view [m], shape (..., d), broadcast against the means.

        Returns:
            probabilities, shape (...), in [0, 1].
        """
        ...

    def draw(self, rng: np.random.Generator, count: int, center: Array) -> Array:
        """Draw points uniformly inside.

        Args:
            rng: source of randomness.
            count: how many.
            center: of the field of view [m], shape (d,).

        Returns:
            points [m], shape (count, d).
        """
        ...


class View(NamedTuple):
    """A field of view where it is at the time of a scan.

    Attributes:
        shape: of it.
        center: of it [m], shape (..., d).
    """

    shape: FieldOfView
    center: Array

    def probability_inside(self, state: Gaussian) -> Array:
        """Probability that states lie inside, position first, shapes (..., n), (..., n, n) to (...)."""
        d = self.center.shape[-1]
        return self.shape.probability_inside(Gaussian(state.x[..., :d], state.P[..., :d, :d]), self.center)


class Everywhere(NamedTuple):
    """A sensor that sees every track; its plots come from a square or cube.

    Attributes:
        volume_: of the square [m^2] or cube [m^3].
        dimensions: 2 or 3.
    """

    volume_: float
    dimensions: int

    @property
    def volume(self) -> float:
        """Area [m^2] in 2-D, volume [m^3] in 3-D."""
        return self.volume_

    def turned(self, heading: float) -> Everywhere:  # noqa: ARG002
        """The same: it has no direction."""
        return self

    def swept(self, left: float, right: float) -> Everywhere:  # noqa: ARG002 (the same all around)
        """The same."""
        return self

    def contains(self, z: Array, center: Array) -> BoolArray:
        """Whether points lie inside: always, shapes (..., d) to (...)."""
        return np.ones(np.broadcast_shapes(z.shape, center.shape)[:-1], dtype=np.bool_)

    def probability_inside(self, position: Gaussian, center: Array) -> Array:
        """Probability that Gaussian positions lie inside: 1.0, shapes (..., d), (..., d, d) to (...)."""
        mean, _ = _relative(position, center)
        return np.ones(mean.shape[:-1])

    def draw(self, rng: np.random.Generator, count: int, center: Array) -> Array:
        """Draw points uniformly in the square or cube around ``center``, shape (count, d)."""
        side = self.volume_ ** (1.0 / self.dimensions)
        points: Array = center + side * rng.uniform(-0.5, 0.5, (count, self.dimensions))
        return points


class AllAround(NamedTuple):
    """A sensor that sees every track and tells no range: its false plots come from all directions alike.

    Attributes:
        dimensions: 2 or 3.
    """

    dimensions: int

    @property
    def volume(self) -> float:
        """Without bound."""
        return np.inf

    def turned(self, heading: float) -> AllAround:  # noqa: ARG002
        """The same: it has no direction."""
        return self

    def swept(self, left: float, right: float) -> AllAround:  # noqa: ARG002 (the same all around)
        """The same."""
        return self

    def contains(self, z: Array, center: Array) -> BoolArray:
        """Whether points lie inside: always, shapes (..., d) to (...)."""
        return np.ones(np.broadcast_shapes(z.shape, center.shape)[:-1], dtype=np.bool_)

    def probability_inside(self, position: Gaussian, center: Array) -> Array:
        """Probability that Gaussian positions lie inside: 1.0, shapes (..., d), (..., d, d) to (...)."""
        mean, _ = _relative(position, center)
        return np.ones(mean.shape[:-1])

    def draw(self, rng: np.random.Generator, count: int, center: Array) -> Array:
        """Draw points in all directions from ``center``, within 1 m, shape (count, d)."""
        return Disc(1.0, self.dimensions).draw(rng, count, center)


class Box(NamedTuple):
    """A rectangle or cuboid with its sides along the axes, or turned.

    Attributes:
        size: full lengths of the sides [m], one per dimension.
        heading: how far it is turned around the vertical [rad], clockwise from north.
    """

    size: tuple[float, ...]
    heading: float = 0.0

    @property
    def volume(self) -> float:
        """Area [m^2] in 2-D, volume [m^3] in 3-D."""
        return float(np.prod(self.size))

    def turned(self, heading: float) -> Box:
        """The box turned further around its center."""
        return self._replace(heading=self.heading + heading)

    def swept(self, left: float, right: float) -> Box | Disc:
        """The disc or ball around it, once it turns."""
        return Disc(0.5 * float(np.linalg.vector_norm(self.size)), len(self.size)) if left or right else self

    def contains(self, z: Array, center: Array) -> BoolArray:
        """Whether points lie inside, the edge included, shapes (..., d) to (...)."""
        return np.asarray(np.all(np.abs(self._along(z - center)) <= 0.5 * np.array(self.size), axis=-1))

    def probability_inside(self, position: Gaussian, center: Array) -> Array:
        """Probability that Gaussian positions lie inside, shapes (..., d), (..., d, d) to (...)."""
        mean, P = _relative(position, center)
        if self.heading:
            turn = self._turn()
            mean, P = np.matvec(turn, mean), turn @ P @ turn.T
        sigma = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
        half = 0.5 * np.array(self.size)
        margin = ((half - np.abs(mean)) / sigma).min(axis=-1)

        def exact(near: BoolArray) -> Array:
            x, s = mean[near], sigma[near]
            correlation = P[near] / (s[:, :, None] * s[:, None, :])
            return _cuboid((-half - x) / s, (half - x) / s, correlation)

        return decide(margin, exact)

    def draw(self, rng: np.random.Generator, count: int, center: Array) -> Array:
        """Draw points uniformly inside, shape (count, d)."""
        points = np.array(self.size) * rng.uniform(-0.5, 0.5, (count, len(self.size)))
        return center + (points @ self._turn() if self.heading else points)

    def _along(self, offset: Array) -> Array:
        """Offsets from the center along the sides, shape (..., d)."""
        return offset @ self._turn().T if self.heading else offset

    def _turn(self) -> Array:
        """Rotation of (east, north(, up)) into the frame of the sides, shape (d, d)."""
        sine, cosine = np.sin(self.heading), np.cos(self.heading)
        turn = np.eye(len(self.size))
        turn[:2, :2] = [[cosine, -sine], [sine, cosine]]
        return turn


class Disc(NamedTuple):
    """A disc; in 3-D the ball.

    Attributes:
        radius: [m].
        dimensions: 2 or 3.
    """

    radius: float
    dimensions: int

    @property
    def volume(self) -> float:
        """Area [m^2] in 2-D, volume [m^3] in 3-D."""
        d = self.dimensions
        return float(np.pi ** (d / 2) / gamma(d / 2 + 1) * self.radius**d)

    def turned(self, heading: float) -> Disc:  # noqa: ARG002
        """The same: it is round."""
        return self

    def swept(self, left: float, right: float) -> Disc:  # noqa: ARG002 (the same all around)
        """The same."""
        return self

    def contains(self, z: Array, center: Array) -> BoolArray:
        """Whether points lie inside, the edge included, shapes (..., d) to (...)."""
        return np.asarray(np.linalg.vector_norm(z - center, axis=-1) <= self.radius)

    def probability_inside(self, position: Gaussian, center: Array) -> Array:
        """Probability that Gaussian positions lie inside, shapes (..., d), (..., d, d) to (...)."""
        mean, P = _relative(position, center)
        variances, axes = np.linalg.eigh(P)
        sigma = np.sqrt(np.maximum(variances, (_SIGMA_MIN * self.radius) ** 2))
        radius = np.full(mean.shape[:-1], self.radius)
        return _ball(radius, np.vecmat(mean, axes), sigma)

    def draw(self, rng: np.random.Generator, count: int, center: Array) -> Array:
        """Draw points uniformly inside, shape (count, d)."""
        direction = rng.standard_normal((count, self.dimensions))
        direction /= np.linalg.vector_norm(direction, axis=-1, keepdims=True)
        return center + self.radius * rng.random((count, 1)) ** (1.0 / self.dimensions) * direction


def _relative(position: Gaussian, center: Array) -> Gaussian:
    """Positions relative to the center, all batch axes broadcast."""
    mean = position.x - center
    batch = np.broadcast_shapes(mean.shape[:-1], position.P.shape[:-2])
    d = mean.shape[-1]
    return Gaussian(np.broadcast_to(mean, (*batch, d)), np.broadcast_to(position.P, (*batch, d, d)))


def _rectangle(lower: Array, upper: Array, rho: Array) -> Array:
    """Probability that two correlated standard normal numbers lie in a rectangle.

    Inclusion and exclusion of the corners in Owen's formula for the distribution function; its terms in Phi cancel.

    Args:
        lower: shape (..., 2).
        upper: shape (..., 2).
        rho: correlations, shape (...).

    Returns:
        probabilities, shape (...).

    References:
        D. B. Owen, Tables for computing bivariate normal probabilities, Ann. Math. Stat. 27 (1956), Eq. (2.1).
    """
    h = np.stack([upper[..., 0], lower[..., 0], lower[..., 0], upper[..., 0]])
    k = np.stack([upper[..., 1], upper[..., 1], lower[..., 1], lower[..., 1]])
    # Off the axes the formula has no special cases, and 1e-14 sigmas do not count.
    h = np.where(np.abs(h) < 1e-14, 1e-14, h)
    k = np.where(np.abs(k) < 1e-14, 1e-14, k)
    rho = np.clip(rho, -_RHO_MAX, _RHO_MAX)
    root = np.sqrt((1.0 - rho) * (1.0 + rho))
    corner = owens_t(h, (k - rho * h) / (h * root)) + owens_t(k, (h - rho * k) / (k * root)) + 0.5 * (h * k < 0.0)
    probability: Array = corner[1] - corner[0] + corner[3] - corner[2]
    return probability


def _cuboid(lower: Array, upper: Array, correlation: Array) -> Array:
    """Probability that correlated standard normal numbers lie in a rectangle or cuboid.

    Args:
        lower: shape (N, d).
        upper: shape (N, d).
        correlation: shape (N, d, d).

    Returns:
        probabilities, shape (N,).
    """
    # An axis that cannot leave the cuboid says nothing, so it may as well be independent of the others.
    certain = np.minimum(-lower, upper) >= CERTAIN
    eye = np.eye(lower.shape[-1])
    correlation = np.where(certain[:, :, None] | certain[:, None, :], eye, correlation)
    probability: Array = interval(lower, upper).prod(axis=-1)
    coupled = np.triu(correlation, 1).any(axis=(-2, -1))
    if coupled.any():
        lower, upper, correlation = lower[coupled], upper[coupled], correlation[coupled]
        plane = lower.shape[-1] == 2
        probability[coupled] = (
            _rectangle(lower, upper, correlation[:, 0, 1]) if plane else _cuboid_corner(lower, upper, correlation)
        )
    return probability


def _cuboid_corner(lower: Array, upper: Array, correlation: Array) -> Array:
    """``_cuboid`` in 3-D where at least two axes are correlated, shapes (N, 3), (N, 3, 3) to (N,)."""
    # The integrand over one axis is as smooth as that axis given the other two, whose variance is det C / (1 - rho^2)
    # with rho of these two: so slice across the axis that has no part in the strongest correlation.
    strength = np.abs(np.stack([correlation[:, i - 2, i - 1] for i in range(3)], axis=-1))
    order = (strength.argmax(axis=-1)[:, None] + np.arange(3)) % 3
    lower = np.take_along_axis(lower, order, axis=-1)
    upper = np.take_along_axis(upper, order, axis=-1)
    correlation = correlation[np.arange(len(order))[:, None, None], order[:, :, None], order[:, None, :]]
    to_slice, in_slice = correlation[:, 0, 1:], correlation[:, 1, 2]
    probability = interval(lower[:, 0], upper[:, 0]) * _rectangle(lower[:, 1:], upper[:, 1:], in_slice)
    coupled = to_slice.any(axis=-1)
    if coupled.any():
        probability[coupled] = _cuboid_by_slices(lower[coupled], upper[coupled], to_slice[coupled], in_slice[coupled])
    return probability


def _cuboid_by_slices(lower: Array, upper: Array, c: Array, rho: Array) -> Array:
    """Integrate the rectangles of a cuboid over its first axis.

    Args:
        lower: shape (N, 3).
        upper: shape (N, 3).
        c: correlations of the first axis with the two others, shape (N, 2).
        rho: correlation of these two, shape (N,).

    Returns:
        probabilities, shape (N,).
    """
    c = np.clip(c, -_RHO_MAX, _RHO_MAX)
    s = np.sqrt((1.0 - c) * (1.0 + c))
    rho = (rho - c.prod(axis=-1)) / s.prod(axis=-1)

    def integrand(owner: Indices, u: Array) -> Array:
        mean, sigma = c[owner, None] * u[..., None], s[owner, None]
        a, b = (lower[owner, None, 1:] - mean) / sigma, (upper[owner, None, 1:] - mean) / sigma
        return normal(u) * _rectangle(a, b, rho[owner, None])

    # Another axis crosses its sides within a few s / |c|. Panels end where a crossing begins and where it ends:
    # those of a thin cigar would slip between the nodes.
    slope = np.where(np.abs(c) < 1e-9, 1e-9, c)[:, None]
    sides, reach = np.stack([lower[:, 1:], upper[:, 1:]], axis=1) / slope, CERTAIN * s[:, None] / slope
    crossings = np.concatenate([sides - reach, sides + reach], axis=1).reshape(-1, 8)
    limits = np.clip(np.stack([lower[:, 0], upper[:, 0]], axis=-1), -CERTAIN, CERTAIN)
    breaks = np.clip(np.concatenate([limits, crossings], axis=-1), limits[:, :1], limits[:, 1:])
    return integrate(integrand, np.sort(breaks, axis=-1))


def _ball(radius: Array, mean: Array, sigma: Array) -> Array:
    """Probability that independent normal numbers lie in a ball around the origin.

    Slices across the narrowest axis, ``y = radius sin(theta)``, are balls of one dimension less with radius
    ``radius cos(theta)``; the widest axis is left for the closed form, and the integrand stays smooth.

    Args:
        radius: shape (...).
        mean: shape (..., d), batch axes broadcast against ``radius``.
        sigma: ascending, shape (..., d), batch axes likewise.

    Returns:
        probabilities, shape (...).
    """
    if mean.shape[-1] == 1:
        return interval((-radius - mean[..., 0]) / sigma[..., 0], (radius - mean[..., 0]) / sigma[..., 0])
    margin = (radius - np.linalg.vector_norm(mean, axis=-1)) / sigma[..., -1]
    mean, sigma = (np.broadcast_to(a, (*radius.shape, a.shape[-1])) for a in (mean, sigma))
    return decide(margin, lambda near: _ball_by_slices(radius[near], mean[near], sigma[near]))


def _ball_by_slices(radius: Array, mean: Array, sigma: Array) -> Array:
    """Integrate the slices of a ball over its first axis: shapes (N,), (N, d), (N, d) to (N,)."""

    def integrand(owner: Indices, theta: Array) -> Array:
        r, m, s = radius[owner, None], mean[owner, None], sigma[owner, None]
        slice_radius = r * np.cos(theta)
        density = normal((r * np.sin(theta) - m[..., 0]) / s[..., 0]) / s[..., 0]
        return density * slice_radius * _ball(slice_radius, m[..., 1:], s[..., 1:])

    reach = CERTAIN * sigma[:, 0]
    ends = np.stack([mean[:, 0] - reach, mean[:, 0] + reach], axis=-1) / radius[:, None]
    return integrate(integrand, np.arcsin(np.clip(ends, -1.0, 1.0)))
