"""Joint probabilistic data association (JPDA): tracks that share the plots of a scan, filtered together (Eq. 21)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from waldnet.common.estimation.association import Clutter, Filtered, Plots, expect, update, weights_alone, within_reach
from waldnet.common.estimation.gaussian import Array, Gaussian, as_array
from waldnet.common.estimation.joint import joint
from waldnet.common.estimation.sensing import Linearised


def jpda(
    predicted: Gaussian, plots: Plots, sensor: Linearised, clutter: Clutter, existence: ArrayLike = 1.0
) -> Filtered:
    """Filter one scan of tracks that compete for its plots: no plot is that of two of them.

    Args:
        predicted: shapes (T, n), (T, n, n).
        plots: of the scan, z of shape (M, m); no plots is evidence too.
        sensor: linearised at ``predicted.x``.
        clutter: detection probability, false plots, gate; shape () or (T,).
        existence: probability of each track to exist, before the scan, shape () or (T,).

    Returns:
        the posterior, shapes (T, n), (T, n, n), and log p_bar of each track given the others, shape (T,).

    References:
        theory.md Eq. (21); Musicki & Evans, Joint integrated probabilistic data association (2004).
    """
    tracks = len(predicted.x)
    one = Gaussian(predicted.x[None, :, None], predicted.P[None, :, None])
    linear = sensor._replace(z=sensor.z[None, :, None], H=_of_component(sensor.H), R=_of_component(sensor.R))
    p_d, log_rho_f = (np.broadcast_to(part, tracks)[:, None] for part in (clutter.p_d, clutter.log_rho_f))
    expected = expect(one, linear, clutter._replace(p_d=p_d, log_rho_f=log_rho_f))
    near = within_reach(expected, plots)
    alone = weights_alone(expected, near)
    exists = np.broadcast_to(as_array(existence), tracks)
    log_nu = joint(np.zeros((tracks, 1)), alone, near.number, plots.z.shape[-2], exists).log_nu
    near = near._replace(log_relative=-log_nu if near.log_relative is None else near.log_relative - log_nu)
    (x, P), log_p_bar = update(expected, near)
    return Filtered(Gaussian(x[0, :, 0], P[0, :, 0]), log_p_bar[:, 0])


def _of_component(matrix: Array) -> Array:
    """Matrices of every track, for its only component; one that all tracks share stays as it is."""
    return matrix[:, None] if matrix.ndim > 2 else matrix
