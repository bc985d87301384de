"""A figure of negative information: what a radar that sees nothing says about a velocity.

``python -m waldnet.studies.notch docs/images/notch.png``: the density of a target's velocity before a scan, after a
miss by one GMTI radar, after misses by two, and after a plot; exact, by a grid, with the filter's Gaussians over it.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from waldnet.common.estimation.association import Clutter, Plots, expect
from waldnet.common.estimation.detection import Notch
from waldnet.common.estimation.gaussian import Array, Gaussian, log_pdf
from waldnet.common.estimation.notch import filtered, hypotheses
from waldnet.common.estimation.sensing import Position

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Minimum detectable velocity [m/s], detection probability outside the notch, density of false plots [1/m^2].
_NOTCH, _P_D, _RHO_F = Notch(2.5), 0.98, 1e-8
#: A car on a road that is not known: position and velocity [m, m/s], 10 km from both radars.
_PRIOR = Gaussian(np.array([0.0, 0.0, 4.0, 3.0]), np.diag([50.0, 50.0, 6.0, 6.0]) ** 2)
_SENSOR = Position((30.0, 30.0), 4)
_WEST, _SOUTH = np.array([-10_000.0, 0.0]), np.array([3000.0, -9500.0])
_PRIOR_COLOUR, _AFTER_COLOUR, _RADAR_COLOUR = "#555555", "#0b7a3b", "#1f4e9e"
_PAPER = {"fc": "white", "ec": "none", "alpha": 0.8}
_REACH, _SHOWN = 22.0, np.array([-15.0, 15.0])


class Look(NamedTuple):
    """A scan of one radar: where it stands [m], and its plots, shape (M, 2)."""

    stand: Array
    plots: Array


def worked_in(prior: Gaussian, look: Look) -> Gaussian:
    """The filter's density after a scan."""
    one = Gaussian(prior.x[None], prior.P[None])
    expected = expect(one, _SENSOR.linearise(one, look.stand), Clutter(np.array(_P_D), np.array(np.log(_RHO_F)), 1.0))
    density = filtered(hypotheses(expected, Plots(look.plots), _NOTCH, look.stand)).density
    return Gaussian(density.x[0], density.P[0])


def exact(velocity: Array, looks: list[Look]) -> Array:
    """Density of velocities, shape (..., 2) to (...), up to a factor; the position is that of the prior's mean."""
    density = np.exp(log_pdf(velocity, Gaussian(_PRIOR.x[2:], _PRIOR.P[2:, 2:])))
    state = np.concatenate([np.zeros_like(velocity), velocity], axis=-1)
    for look in looks:
        p_d = _P_D * _NOTCH.share(state, look.stand)
        density = density * (p_d if len(look.plots) else 1.0 - p_d)
    return density


def draw(path: Path) -> None:
    """Write the figure."""
    figure = Figure(figsize=(13.5, 5.9), layout="constrained")
    FigureCanvasAgg(figure)
    nothing, here = np.empty((0, 2)), np.zeros((1, 2))
    panels = {
        "one radar, in the west, sees nothing": [Look(_WEST, nothing)],
        "a second, in the south, sees nothing either": [Look(_WEST, nothing), Look(_SOUTH, nothing)],
        "or: the radar in the west has a plot": [Look(_WEST, here)],
    }
    for axes, (title, looks) in zip(figure.subplots(1, 3, sharex=True, sharey=True), panels.items(), strict=True):
        _draw_panel(axes, looks)
        axes.set_title(title, fontsize=11)
        axes.set_xlabel("velocity to the east [m/s]")
    figure.axes[0].set_ylabel("velocity to the north [m/s]")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=10)
    figure.suptitle(
        f"What a missed detection says: clutter notch, minimum detectable velocity {_NOTCH.mdv:g} m/s, p_d {_P_D:g}",
        fontsize=12,
    )
    figure.savefig(path, dpi=110)


def _draw_panel(axes: Axes, looks: list[Look]) -> None:
    side = np.linspace(-_REACH, _REACH, 401)
    grid = np.stack(np.meshgrid(side + _PRIOR.x[2], side + _PRIOR.x[3]), axis=-1)
    density = exact(grid, looks)
    axes.contourf(grid[..., 0], grid[..., 1], density / density.max(), levels=np.linspace(0.05, 1.0, 12), cmap="Greens")
    after = _PRIOR
    for look in looks:
        after = worked_in(after, look)
        _draw_notch(axes, look.stand)
    _draw_ellipse(axes, _PRIOR, _PRIOR_COLOUR, "--", "before, 1 and 2 sigma")
    _draw_ellipse(axes, after, _AFTER_COLOUR, "-", "filter after the scan, 1 and 2 sigma")
    axes.set(xlim=_PRIOR.x[2] + _SHOWN, ylim=_PRIOR.x[3] + _SHOWN)
    axes.set_aspect("equal")
    spread = np.sqrt(np.diag(after.P)[2:])
    text = f"sigma 6.0, 6.0 → {spread[0]:.1f}, {spread[1]:.1f} m/s"
    axes.text(0.97, 0.97, text, transform=axes.transAxes, ha="right", va="top", fontsize=10, bbox=_PAPER)


def _draw_notch(axes: Axes, stand: Array) -> None:
    """Velocities across the line of sight, in which the radar sees nothing."""
    toward = -stand / np.linalg.vector_norm(stand)
    across = 40.0 * np.array([-toward[1], toward[0]])
    first = not axes.lines
    for sign in (-1.0, 1.0):
        ends = sign * _NOTCH.mdv * toward + np.stack([-across, across])
        label = "clutter notch: half of p_d at its edges" if sign > 0.0 and first else None
        axes.plot(ends[:, 0], ends[:, 1], color=_RADAR_COLOUR, lw=0.9, ls=":", label=label)


def _draw_ellipse(axes: Axes, density: Gaussian, colour: str, style: str, label: str) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ np.linalg.cholesky(density.P[2:, 2:]).T
    for radius in (1.0, 2.0):
        line = density.x[2:] + radius * circle
        axes.plot(line[:, 0], line[:, 1], color=colour, ls=style, lw=1.4, label=label if radius == 1.0 else None)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
