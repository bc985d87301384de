"""The ``[fusion]`` table of a scenario file: how the network shares a density, and who associates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field

from waldnet.common.estimation.association import Choice, kalman, nearest, normalise
from waldnet.common.estimation.mixture import Reduction
from waldnet.common.estimation.selection import Selection
from waldnet.common.quantities import Delay, GateProbability, InnerProbability, NotNegative, Positive

CHOICES: dict[str, Choice] = {"kalman": kalman, "nearest": nearest, "pdaf": normalise}


class MixtureConfig(BaseModel, extra="forbid", frozen=True):
    """How far the mixture of a track may grow (theory.md §9).

    Attributes:
        components: most components of a track.
        prune: hypotheses lighter than this share of the heaviest are dropped.
        combine: hypotheses closer than this to a heavier one (squared Mahalanobis distance) are combined with it.
    """

    components: Annotated[int, Field(ge=1, le=1000, strict=True)] = 15
    prune: Annotated[NotNegative, Field(lt=1.0)] = 1e-4
    combine: NotNegative = 0.5

    def build(self) -> Reduction:
        """The reduction of mixtures."""
        return Reduction(self.components, self.prune, self.combine)


class SelectionConfig(BaseModel, extra="forbid", frozen=True):
    """Which plots a node sends where the center tracks (theory.md §5).

    Attributes:
        probability: that the target's plot is inside the gate of the hypothesis that is right.
        weight: hypotheses lighter than this share of all have no say.
    """

    probability: InnerProbability = 0.99
    weight: Annotated[Positive, Field(lt=1.0)] = 1e-3

    def build(self) -> Selection:
        """The selection of plots."""
        return Selection(self.probability, self.weight)


class FusionConfig(BaseModel, extra="forbid", frozen=True):
    """How the network shares a density and who associates.

    Attributes:
        mode: representation of the product (theory.md §4); selected: no product, the nodes send the plots that matter
            to their tracks and the center tracks with them (theory.md §5).
        association: the factor's own, tight, or mirrored: hypotheses kept in both filters (theory.md §5).
        terms: most terms of a track in a report; more than one only where association is mirrored.
        feedback: advice gives the fused track back to the association filters, reset to the factors (theory.md §3, 6).
            Default: advice where tracks start by themselves and nodes have such filters, else none.
        feedback_delay: measurement time that goes by before feedback counts [s]; with reset, nobody is left out who
            hears of it in that time.
        filter: local filter; default: mht where association is mirrored or mode selected, else pdaf.
        mixture: of filter mht.
        selection: of mode selected.
        precision: of means and covariances in reports; float32 halves them.
        joint: tracks near each other share plots jointly; else each is associated as if it were alone. Default: where
            tracks start by themselves; given hypotheses may be about the same target.
        gate_probability: that the target's plot lies inside the gate; 1 is no gate.
        hold_back: how long the center waits for a sensor that is overdue [s].
        window: how far back a late report is still worked in [s of measurement time].
    """

    mode: Literal["naive", "federated", "dkf", "selected"] = "federated"
    association: Literal["factor", "tight", "mirrored"] = "tight"
    terms: Annotated[int, Field(ge=1, le=64, strict=True)] = 1
    feedback: Literal["none", "advice", "reset"] = "none"
    feedback_delay: Delay = 0.0
    filter: Literal["kalman", "nearest", "pdaf", "mht"] | None = None
    mixture: MixtureConfig = MixtureConfig()
    selection: SelectionConfig = SelectionConfig()
    precision: Literal["float64", "float32"] = "float64"
    joint: bool | None = None
    gate_probability: GateProbability = 0.9997
    hold_back: Delay = 0.5
    window: Delay = 10.0

    @property
    def choice(self) -> Choice | None:
        """How a single Gaussian is associated; None: hypotheses are kept in a mixture."""
        several = self.association == "mirrored" or self.mode == "selected"
        name = self.filter or ("mht" if several else "pdaf")
        return None if name == "mht" else CHOICES[name]


def can_use_advice(fusion: Mapping[str, Any]) -> bool:
    """Whether nodes of a ``[fusion]`` table have an association filter of a single Gaussian, which advice steers."""
    tight = fusion.get("association", "tight") == "tight" and fusion.get("filter") != "mht"
    return tight and fusion.get("mode", "federated") != "selected"


def fusion_faults(fusion: Mapping[str, Any], motion_model: Any) -> Iterator[str]:
    """Faults between keys of ``[fusion]``, and with the motion model; tolerant of whatever else is wrong."""
    mode, association, filter_ = (
        fusion.get(key, default) for key, default in (("mode", "federated"), ("association", "tight"), ("filter", None))
    )
    feedback, terms = fusion.get("feedback", "none"), fusion.get("terms", 1)
    mixture = association == "mirrored" or filter_ == "mht"
    if feedback == "advice" and not can_use_advice({**fusion, "mode": "federated"}):
        yield (
            "fusion.feedback: 'advice' steers the association filter of a single Gaussian, "
            "which only association = 'tight' with another filter than 'mht' has"
        )
    if association == "mirrored" and filter_ not in (None, "mht"):
        yield f"fusion.filter: {filter_!r} keeps one hypothesis; association = 'mirrored' needs 'mht', or no filter key"
    if association != "mirrored" and isinstance(terms, int) and terms > 1:
        yield f"fusion.terms: {terms} terms of a report need association = 'mirrored'"
    if motion_model == "imm" and mixture:
        yield "fusion: several motion models ('imm') are for a single Gaussian each: no 'mirrored', no 'mht'"
    if mode == "dkf" and motion_model == "imm":
        yield "fusion.mode: 'dkf' predicts with one motion model, [motion] has several ('imm')"
    if mode == "selected" and ("association" in fusion or feedback != "none"):
        yield "fusion.mode: 'selected' has no factors: no association, no feedback"
    if mode == "dkf" and (mixture or feedback == "reset"):
        yield "fusion.mode: 'dkf' needs covariances that do not depend on data: no mixture, no feedback = 'reset'"
    delay, window = fusion.get("feedback_delay", 0.0), fusion.get("window", 10.0)
    if isinstance(delay, int | float) and isinstance(window, int | float) and delay > window:
        yield f"fusion.feedback_delay: {delay} s is longer than the {window} s (fusion.window) that nodes keep scans"
