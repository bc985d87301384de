"""How figures of a study look: one colour, line and marker for each mode, the same everywhere.

Colours are those of Okabe & Ito, which people of any colour vision tell apart. Related modes share one and differ in
line and marker.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator

from waldnet.common.estimation.gaussian import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLACK, GREY, ORANGE, SKY = "#000000", "#7f7f7f", "#e69f00", "#56b4e9"
GREEN, BLUE, RED, PURPLE = "#009e73", "#0072b2", "#d55e00", "#b0558f"
#: Of frames, grids and words that are not data.
FAINT, QUIET = "#e4e4e4", "#5a5a5a"

_DASHED, _DOTTED, _BOTH = (0, (5, 2)), (0, (1.2, 1.6)), (0, (6, 2, 1.2, 2))


class Look(NamedTuple):
    """How a mode is drawn."""

    colour: str
    line: Any
    marker: str

    @property
    def size(self) -> float:
        """Of the marker in points, so that all look equally large."""
        return 8.5 if self.marker == "*" else 6.0


_LOOKS = {
    "centralised": Look(BLACK, "-", "o"),
    "centralised-mht": Look(BLACK, _DASHED, "D"),
    "naive": Look(GREY, "-", "X"),
    "dkf": Look(GREY, _DASHED, "P"),
    "federated": Look(RED, "-", "s"),
    "federated-reset": Look(RED, _DASHED, "D"),
    "federated-tight": Look(BLUE, "-", "o"),
    "federated-tight-reset": Look(BLUE, _DASHED, "D"),
    "federated-tight-advice": Look(SKY, "-", "h"),
    "federated-mirrored-1": Look(GREEN, _DOTTED, "v"),
    "federated-mirrored-3": Look(GREEN, _DASHED, "<"),
    "federated-mirrored-8": Look(GREEN, "-", "^"),
    "decentralised-mean": Look(PURPLE, "-", "p"),
    "decentralised-decisions": Look(PURPLE, _DASHED, "*"),
}
_OTHERS = [Look(ORANGE, line, marker) for line, marker in zip(("-", _DASHED, _DOTTED, _BOTH), "sDv^", strict=True)]

#: Of all figures of a study.
SETTINGS: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelcolor": QUIET,
    "axes.edgecolor": "#b0b0b0",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.8,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "legend.frameon": False,
    "legend.handlelength": 3.2,
    "lines.linewidth": 1.7,
    "svg.fonttype": "path",
}


def look(mode: str) -> Look:
    """How a mode is drawn; one that is not known here is orange, always the same way."""
    return _LOOKS.get(mode) or _OTHERS[zlib.crc32(mode.encode()) % len(_OTHERS)]


def line(axes: Axes, mode: str, x: Any, y: Any, **style: Any) -> None:
    """A curve of a mode."""
    drawn = look(mode)
    axes.plot(x, y, color=drawn.colour, ls=drawn.line, **style)


def bytes_axis(axes: Axes, sent: Array) -> None:
    """A logarithmic axis of bytes that says plain numbers, and at least two of them."""
    known = sent[sent > 0.0]
    if not known.size:
        return
    axes.set_xscale("log")
    axes.set_xlim(known.min() / 1.8, known.max() * 1.8)
    if known.max() < 30.0 * known.min():
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def legend(figure: Figure, modes: Sequence[str]) -> None:
    """All modes beside the panels, where they hide no data."""
    handles = []
    for mode in modes:
        drawn = look(mode)
        handles.append(Line2D([], [], color=drawn.colour, ls=drawn.line, label=mode))
    figure.legend(handles=handles, loc="outside right upper")
