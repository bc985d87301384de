"""The ``[motion]`` table of a scenario file: one motion model, or several that the target changes between."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, Field

from waldnet.common.estimation.imm import Imm
from waldnet.common.estimation.motion import ConstantAcceleration, ConstantVelocity, CoordinatedTurn, Kinematic, Motion
from waldnet.common.quantities import Duration, Finite, NotNegative

Model: TypeAlias = Literal["cv", "ca", "ct"]
Dimensions: TypeAlias = Literal[2, 3]


class ModelConfig(BaseModel, extra="forbid", frozen=True):
    """One of the models of an IMM.

    Attributes:
        model: constant velocity, constant acceleration, or a coordinated turn.
        psd: of the process noise [m^2/s^3, for ca m^2/s^5].
        turn_rate: of ct, counter-clockwise seen from above [rad/s].
    """

    model: Model = "cv"
    psd: NotNegative
    turn_rate: Finite | None = None

    def build(self, dimensions: Dimensions) -> Kinematic:
        """The motion model."""
        return _kinematic(self.model, dimensions, self.psd, self.turn_rate)


class MotionConfig(BaseModel, extra="forbid", frozen=True):
    """How targets move; which keys a model needs is checked with the whole file.

    Attributes:
        model: constant velocity, constant acceleration, a coordinated turn, or several models (imm).
        dimensions: of the position.
        psd: of the process noise [m^2/s^3, for ca m^2/s^5]; with imm every model has its own, and this one is of the
            single model that stands for all where only one can be had, such as the center's prediction.
        turn_rate: of ct, counter-clockwise seen from above [rad/s].
        sojourn: of imm: mean time until a target takes another model [s].
        models: of imm, two or more that share one state: cv and ct, or ca.
    """

    model: Literal["cv", "ca", "ct", "imm"] = "cv"
    dimensions: Dimensions = 2
    psd: NotNegative | None = None
    turn_rate: Finite | None = None
    sojourn: Duration | None = None
    models: Annotated[tuple[ModelConfig, ...], Field(min_length=2)] | None = None

    def build(self) -> Motion:
        """The motion model."""
        if self.model == "imm":
            assert self.sojourn is not None and self.models is not None
            return Imm.of(tuple(model.build(self.dimensions) for model in self.models), self.sojourn, self.psd)
        assert self.psd is not None
        return _kinematic(self.model, self.dimensions, self.psd, self.turn_rate)


def _kinematic(model: Model, dimensions: Dimensions, psd: float, turn_rate: float | None) -> Kinematic:
    if model == "ca":
        return ConstantAcceleration(dimensions, psd)
    if model == "ct":
        assert turn_rate is not None
        return CoordinatedTurn(dimensions, psd, turn_rate)
    return ConstantVelocity(dimensions, psd)


def numbers_per_axis(motion: Mapping[str, Any]) -> int:
    """How many numbers of a state belong to one axis: 2, with accelerations 3."""
    return 3 if any(entry.get("model") == "ca" for entry in (motion, *_entries(motion))) else 2


def motion_faults(motion: object) -> Iterator[str]:
    """Faults between the keys of ``[motion]``, whatever else is wrong with it."""
    if not isinstance(motion, dict):
        return
    model = motion.get("model", "cv")
    if model == "imm":
        yield from _imm_faults(motion)
    elif model in ("cv", "ca", "ct"):
        if "psd" not in motion:
            yield "motion.psd: is missing"
        yield from _turn_faults(motion, "motion")
        for key in sorted({"sojourn", "models"} & motion.keys()):
            yield f"motion.{key}: is of model = 'imm', not of {model!r}"


def _imm_faults(motion: Mapping[str, Any]) -> Iterator[str]:
    if "turn_rate" in motion:
        yield "motion.turn_rate: with model = 'imm' every entry of motion.models has its own"
    for key in sorted({"sojourn", "models"} - motion.keys()):
        yield f"motion.{key}: is missing"
    rates = [entry.get("turn_rate", 0.0) for entry in _entries(motion)]
    if "psd" not in motion and any(rate != rates[0] for rate in rates):
        yield (
            "motion.psd: is missing; the models turn at different rates, and the single model that stands for all "
            "where only one can be had needs a psd that covers them"
        )
    kinds = {str(entry.get("model", "cv")) for entry in _entries(motion)}
    if "ca" in kinds and kinds & {"cv", "ct"}:
        yield "motion.models: the state of 'ca' has accelerations, that of 'cv' and 'ct' none; all must share one"
    for i, entry in enumerate(_entries(motion)):
        yield from _turn_faults(entry, f"motion.models.{i}")


def _turn_faults(entry: Mapping[str, Any], where: str) -> Iterator[str]:
    model = entry.get("model", "cv")
    if model == "ct" and "turn_rate" not in entry:
        yield f"{where}.turn_rate: is missing"
    if model in ("cv", "ca") and "turn_rate" in entry:
        yield f"{where}.turn_rate: is of model = 'ct', not of {model!r}"


def _entries(motion: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    models = motion.get("models")
    return [entry for entry in models if isinstance(entry, dict)] if isinstance(models, list) else []
