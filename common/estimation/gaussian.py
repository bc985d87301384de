"""Gaussian densities: log pdf, products, moments."""

from __future__ import annotations

from functools import cache, lru_cache
from typing import NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotrf, dtrtri

Array: TypeAlias = NDArray[np.float64]
BoolArray: TypeAlias = NDArray[np.bool_]

#: Up to so many matrices, LAPACK's calls cost less than NumPy's.
_FEW = 4

LOG_2PI = float(np.log(2.0 * np.pi))


def as_array(value: ArrayLike) -> Array:
    """Numbers as an array; an array is taken as it is, at next to no cost."""
    return value if type(value) is np.ndarray else np.asarray(value, np.float64)


class _GaussianFields(NamedTuple):
    x: Array
    P: Array


class Gaussian(_GaussianFields):
    """Gaussian densities, one per leading batch index; lists of numbers are welcome.

    Attributes:
        x: means, shape (..., n).
        P: covariances, shape (..., n, n), symmetric positive definite.
    """

    __slots__ = ()

    def __new__(cls, x: ArrayLike, P: ArrayLike) -> Self:
        """Take lists for arrays."""
        return tuple.__new__(cls, (as_array(x), as_array(P)))


class Whitened(NamedTuple):
    """Gaussian densities, taken apart: with ``P = L L'``, ``L^-1 (z - x)`` is white.

    Attributes:
        x: means, shape (..., n).
        W: L^-1, shape (..., n, n).
        half_log_det: 0.5 log det P, shape (...).
    """

    x: Array
    W: Array
    half_log_det: Array


class Product(NamedTuple):
    """A product of Gaussian densities: ``c N(x; mean, covariance)``.

    Attributes:
        density: the normalised product, shapes (..., n), (..., n, n).
        log_c: logarithm of the normalisation constant c, shape (...).
    """

    density: Gaussian
    log_c: Array


@cache
def identity(n: int) -> Array:
    """The identity of size ``n``, to read only."""
    eye = np.eye(n)
    eye.flags.writeable = False
    return eye


def symmetric(P: Array) -> Array:
    """Return the symmetric part of ``P``, shape (..., n, n): rounding never adds up to a skew."""
    return 0.5 * (P + P.mT)


def times_transposed(P: Array, A: Array) -> Array:
    """``P A'``, shapes (..., k, n) and (m, n) or (..., m, n) to (..., k, m).

    A matrix that the whole batch shares takes one product; NumPy would do as many small ones as there are batches.
    Where everyone has his own, a copy of the transposed ones pays: NumPy is slow with strides.
    """
    if A.ndim > 2:
        return P @ np.ascontiguousarray(A.mT)
    return (P.reshape(-1, P.shape[-1]) @ A.T).reshape(*P.shape[:-1], len(A))


def gram(W: Array) -> Array:
    """``W'W``, shape (..., k, n) to (..., n, n)."""
    return np.ascontiguousarray(W.mT) @ W


def squared_norm(w: Array) -> Array:
    """``w'w``, shape (..., n) to (...), for n small: component by component is faster than many tiny dot products."""
    total: Array = np.square(w[..., 0])
    for i in range(1, w.shape[-1]):
        total = total + np.square(w[..., i])
    return total


def cholesky(P: Array) -> Array:
    """Lower Cholesky factors of ``P``, shape (..., n, n).

    Raises:
        numpy.linalg.LinAlgError: when a matrix is not positive definite, by more than rounding.
    """
    try:
        L: Array = np.linalg.cholesky(P).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:
        L = np.asarray(np.linalg.inv(settled_whitener(P)[1]), np.float64)
    return L


def whiten(L: Array, d: Array) -> Array:
    """Solve ``L w = d`` by forward substitution.

    NumPy has no batched triangular solve; its rows are few, so a loop over them is faster than a general solve.

    Args:
        L: lower Cholesky factors, shape (..., n, n).
        d: right-hand sides, shape (..., n), broadcast against the batch axes of ``L``.

    Returns:
        w, shape (..., n).
    """
    first = d[..., 0] / L[..., 0, 0]
    w = np.empty((*first.shape, L.shape[-1]))
    w[..., 0] = first
    for i in range(1, L.shape[-1]):
        rest = d[..., i] - L[..., i, 0] * first
        for j in range(1, i):
            rest -= L[..., i, j] * w[..., j]
        w[..., i] = rest / L[..., i, i]
    return w


def half_log_det(L: Array) -> Array:
    """``0.5 log det P`` from the Cholesky factor ``L`` of P, shape (..., n, n) to (...)."""
    determinant: Array = L[..., 0, 0]
    for i in range(1, L.shape[-1]):
        determinant = determinant * L[..., i, i]
    return np.log(determinant)


def whitener(P: Array) -> tuple[Array, Array]:
    """Inverse Cholesky factors ``L^-1`` of ``P = L L'``, and ``0.5 log det P``.

    Gaussian elimination of ``[P | I]``, without pivots as P is positive definite, leaves ``D L'`` on the left and
    the whitener on the right, up to the roots of the pivots. The batch is the last axis meanwhile: a step of the
    elimination is then a handful of operations on long rows, for one matrix and for thousands.

    Args:
        P: shape (..., n, n).

    Returns:
        ``L^-1``, lower triangular, shape (..., n, n), and ``0.5 log det P``, shape (...).

    Raises:
        numpy.linalg.LinAlgError: when a matrix is not positive definite.
    """
    n = P.shape[-1]
    if P.size <= _FEW * n * n:
        return _whitener_of_few(P)
    A = np.empty((n, 2 * n, P.size // (n * n)))
    A[:, :n], A[:, n:] = P.reshape(-1, n, n).T, identity(n)[..., None]
    with np.errstate(all="ignore"):  # what is not positive definite is found below
        for k in range(n - 1):
            # Columns before these are done, and those after them still zero.
            active = slice(k + 1, n + k + 1)
            rest = A[k + 1 :, active]
            rest -= A[k + 1 :, k, None] * (A[k, active] / A[k, k])
    pivots = A.diagonal()
    if not pivots.min(initial=1.0) > 0.0:
        raise np.linalg.LinAlgError("a matrix is not positive definite")
    W = np.empty((pivots.shape[0], n, n))
    np.divide(A[:, n:], np.sqrt(pivots.T)[:, None], out=W.transpose(1, 2, 0))
    return W.reshape(P.shape), 0.5 * np.log(pivots).sum(axis=-1).reshape(P.shape[:-2])


def _whitener_of_few(P: Array) -> tuple[Array, Array]:
    """``whitener`` by LAPACK, one matrix after the other: for a few that takes less calls than the elimination."""
    W = np.empty_like(P, order="C")
    rows = W.reshape(-1, *P.shape[-2:])
    for i, matrix in enumerate(P.reshape(rows.shape)):
        L, failed = dpotrf(matrix.T, lower=1)
        if failed or L[-1, -1] != L[-1, -1]:  # LAPACK lets NaN pass
            raise np.linalg.LinAlgError("a matrix is not positive definite")
        rows[i], _ = dtrtri(L, lower=1)
    return W, -np.log(W.diagonal(axis1=-2, axis2=-1)).sum(axis=-1)


def settled_whitener(P: Array) -> tuple[Array, Array, Array]:
    """``whitener`` of covariances, or of information matrices, that are positive definite but for rounding.

    Where a sharp position and a vague velocity are predicted over a long time, their correlation is 1 to all digits.
    Such a matrix gets a larger diagonal, by the smallest part of it that helps: a density that is a little wider.

    Args:
        P: shape (..., n, n).

    Returns:
        the matrices, as they are where they are positive definite; and what ``whitener`` makes of them.

    Raises:
        numpy.linalg.LinAlgError: when a matrix is not positive definite by far, or not finite.
    """
    try:
        return P, *whitener(P)
    except np.linalg.LinAlgError:
        flat = P.reshape(-1, *P.shape[-2:]).copy()
        for part in 2.0 ** np.arange(-50, -19, 3):
            bad = ~are_positive_definite(flat)
            flat[bad] += part * flat[bad] * identity(P.shape[-1])
        P = flat.reshape(P.shape)
        return P, *whitener(P)


def are_positive_definite(P: Array) -> BoolArray:
    """Which covariances ``whitener`` can take apart, shape (N, n, n) to (N,), however many there are with them."""
    good = np.ones(len(P), np.bool_)
    try:
        whitener(P)
    except np.linalg.LinAlgError:
        pass
    else:
        if len(P) > _FEW:
            return good
    for i, matrix in enumerate(P):
        try:
            # A few and many go different ways.
            for count in (1, _FEW + 1):
                whitener(np.broadcast_to(matrix, (count, *matrix.shape)))
        except np.linalg.LinAlgError:
            good[i] = False
    return good


def quadratic(d: Array, S: Array) -> tuple[Array, Array]:
    """``d' S^-1 d`` and ``0.5 log det S``, shapes (N, n), (N, n, n) to (N,), for S symmetric positive definite.

    Elimination without pivots, the batch on the last axis: a step is a handful of operations on long rows.
    """
    # The upper triangle is enough.
    A, b = np.ascontiguousarray(np.moveaxis(S, 0, -1)), np.ascontiguousarray(d.T)
    total, determinant = np.zeros(len(d)), np.ones(len(d))
    for k in range(len(b)):
        pivot = A[k, k]
        total += b[k] * b[k] / pivot
        determinant *= pivot
        factor = A[k, k + 1 :] / pivot
        b[k + 1 :] -= factor * b[k]
        for i in range(k + 1, len(b)):
            A[i, i:] -= factor[i - k - 1] * A[k, i:]
    return total, 0.5 * np.log(determinant)


def joseph(P: Array, K: Array, H: Array, R: Array) -> Array:
    """Covariance of a Kalman update, ``(I - K H) P (I - K H)' + K R K'``.

    As it stands in textbooks, ``P - K S_k K'`` loses all digits where a sharp plot meets a wide prior.

    Args:
        P: predicted covariances, shape (..., n, n).
        K: gains, shape (..., n, m).
        H: measurement matrix, shape (m, n) or (..., m, n).
        R: measurement noise, shape (m, m) or (..., m, m).

    Returns:
        updated covariances, shape (..., n, n).
    """
    A = identity(P.shape[-1]) - times_transposed(K, H.mT)
    return symmetric(times_transposed(A @ P, A) + times_transposed(times_transposed(K, R), K))


def log_pdf(at: Array, density: Gaussian) -> Array:
    """Logarithm of ``N(at; x, P)``.

    Args:
        at: points, shape (..., n), broadcast against the batch axes of ``density``.
        density: the Gaussians.

    Returns:
        log density, shape (...).
    """
    L = cholesky(density.P)
    w = whiten(L, at - density.x)
    result: Array = -0.5 * squared_norm(w) - half_log_det(L) - 0.5 * LOG_2PI * L.shape[-1]
    return result


def product(factors: Gaussian, members: BoolArray | None = None) -> Product:
    r"""Normalised product of several factors and its constant (Eq. 8, 9): one batched pass, no fold.

    The density is the convex combination (information sum) of Eq. (9). For the constant, evaluate the identity
    ``prod_s N(x; x^s, P^s) = c N(x; x_f, P_f)`` at x = x_f, where the right side is ``c |2 pi P_f|^(-1/2)``::

        log c = sum_s log N(x_f; x^s, P^s) + 0.5 log |2 pi P_f|

    This is Eq. (8) without its order of sensors: every term is a difference to one and the same point.

    Args:
        factors: x of shape (..., S, n), P of shape (..., S, n, n); axis -2 of x counts the sensors.
        members: shape (..., S); factors that are no members count as constant 1. None: all are members.

    Returns:
        the product; where there is a single member c = 1.

    References:
        theory.md Eq. (8), (9); N. Carlson, Federated square root filter (1990).
    """
    return multiply(Whitened(factors.x, *whitener(factors.P)), members)


def multiply(factors: Whitened, members: BoolArray | None = None) -> Product:
    """``product`` of factors that are whitened already."""
    x, W, half = factors
    *batch, n_sensors, n = x.shape
    half = half + 0.5 * LOG_2PI * n
    if members is not None:
        W, half = W * members[..., None, None], half * members
    # P^-1 = W'W: with the rows of all sensors one below the other, the sum over them is one product.
    rows = W.reshape(*batch, n_sensors * n, n)
    _, V, half_information = settled_whitener(gram(rows))
    P = gram(V)
    # Relative to the first factor, so that large coordinates cost no digits.
    reference = x[..., :1, :]
    u = np.matvec(W, x - reference).reshape(*batch, n_sensors * n)
    shift = np.matvec(P, np.vecmat(u, rows))
    w = np.matvec(rows, shift) - u
    log_c = -0.5 * np.vecdot(w, w) - half.sum(axis=-1) - half_information + 0.5 * LOG_2PI * n
    return Product(Gaussian(reference[..., 0, :] + shift, P), log_c)


def draw_noise(rng: np.random.Generator, P: Array, count: int) -> Array:
    """Draw from N(0, P), shape (count, n): digit by digit as ``rng.multivariate_normal`` does, P taken apart once."""
    return np.asarray(rng.standard_normal((count, len(P))) @ _root(P.tobytes(), len(P)))


@lru_cache(maxsize=1024)
def _root(P: bytes, n: int) -> Array:
    """``A`` with ``A' A = P``, shape (n, n), of the matrix with these bytes."""
    U, s, _ = np.linalg.svd(np.frombuffer(P).reshape(n, n))
    root: Array = (U * np.sqrt(s)).T
    return root


def moments(weights: Array, components: Gaussian) -> Gaussian:
    """Mean and covariance of Gaussian mixtures (moment matching).

    Args:
        weights: shape (..., K), non-negative with sum one.
        components: x of shape (..., K, n), P of shape (..., K, n, n).

    Returns:
        one Gaussian per mixture, shapes (..., n), (..., n, n).
    """
    x = np.einsum("...k,...ki->...i", weights, components.x)
    d = components.x - x[..., None, :]
    P = np.einsum("...k,...kij->...ij", weights, components.P) + np.einsum("...k,...ki,...kj->...ij", weights, d, d)
    return Gaussian(x, symmetric(P))


def log_sum_exp(log_weights: Array) -> Array:
    """``log sum exp`` over the last axis; all weights zero gives -inf without a warning.

    Args:
        log_weights: shape (..., K).

    Returns:
        shape (...).
    """
    top = log_weights.max(axis=-1, keepdims=True)
    safe = np.where(np.isfinite(top), top, 0.0)
    total = np.exp(log_weights - safe).sum(axis=-1)
    result: Array = np.log(total, out=np.full_like(total, -np.inf), where=total > 0.0) + safe[..., 0]
    return result
