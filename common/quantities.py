"""Quantities of scenario files: numbers and instants that say what is wrong with them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from waldnet.common.limits import (
    FULL_CIRCLE,
    MAX_FALSE_PLOTS,
    MAX_NUMBER,
    MAX_PLOTS,
    MAX_SECONDS,
    MAX_VALUE,
    MIN_FALSE_PLOTS,
    MIN_SECONDS,
    MIN_SIGMA,
    ZENITH,
)

NS_PER_S = 1_000_000_000


class Model(BaseModel):
    """A table of a scenario file: no other keys, and nothing changes."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def _probability(value: float) -> float:
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{value:g} is not a probability (0 to 1)")
    return value


def _inner_probability(value: float) -> float:
    if not 0.0 < value < 1.0:
        raise ValueError(f"{value:g} is not a probability strictly between 0 and 1")
    return value


def _gate_probability(value: float) -> float:
    if not 0.0 < value <= 1.0:
        raise ValueError(f"{value:g} is not a probability above 0 (1 is no gate)")
    return value


def _positive(value: float) -> float:
    if not 0.0 < value < float("inf"):
        raise ValueError(f"{value:g} is not positive and finite")
    return value


def _not_negative(value: float) -> float:
    if not 0.0 <= value < float("inf"):
        raise ValueError(f"{value:g} is not zero or positive and finite")
    return value


def _finite(value: float) -> float:
    if not np.isfinite(value):
        raise ValueError(f"{value:g} is not finite")
    return value


def _within(low: float, high: float) -> AfterValidator:
    """Numbers that can be computed with: their squares and products neither overflow nor vanish."""

    def check(value: float) -> float:
        if not low <= value <= high:
            raise ValueError(f"{value:g} is not between {low:g} and {high:g}")
        return value

    return AfterValidator(check)


def _angle(value: float) -> float:
    if not -2.0 * np.pi <= value <= 2.0 * np.pi:
        raise ValueError(f"{value:g} is no angle in radians (-2 pi to 2 pi)")
    return value


def _span(value: float) -> float:
    if not 0.0 < value <= FULL_CIRCLE:
        raise ValueError(f"{value:g} is no span of azimuths in radians (above 0, up to 2 pi)")
    return min(value, 2.0 * np.pi)


def _elevation(value: float) -> float:
    if not -ZENITH <= value <= ZENITH:
        raise ValueError(f"{value:g} is no elevation in radians (-pi/2 to pi/2)")
    return float(np.clip(value, -0.5 * np.pi, 0.5 * np.pi))


def _false_plots(value: float) -> float:
    if not 0.0 < value < float("inf"):
        raise ValueError(
            f"{value:g} is not positive and finite; without false plots one plot would prove a target and there is "
            "nothing to test: give the smallest mean you believe, such as 1e-6"
        )
    if value > MAX_PLOTS:
        raise ValueError(
            f"{value:g} is more than the {MAX_PLOTS} plots that a scan may have; it is the mean number in one scan of "
            "the whole field of view, not a density"
        )
    return value


def _seconds(value: float) -> float:
    if not -MAX_SECONDS <= value <= MAX_SECONDS:
        raise ValueError(f"{value:g} s is farther from the epoch than {MAX_SECONDS:g} s")
    return value


def _no_number(value: object) -> object:
    if isinstance(value, int | float):
        raise ValueError(f"{value!r} is no instant; write it like 2026-01-01T00:00:00Z")
    return value


def _instant(value: datetime) -> datetime:
    if value.tzinfo is None:
        raise ValueError(f"{value.isoformat()} has no time zone; write it like 2026-01-01T00:00:00Z")
    if not 1900 <= value.year <= 2100:
        raise ValueError(f"{value.isoformat()} is not between the years 1900 and 2100")
    return value


#: A number and nothing that could be read as one, such as true or "0.5".
_NUMBER = Field(strict=True)
Probability = Annotated[float, _NUMBER, AfterValidator(_probability)]
InnerProbability = Annotated[float, _NUMBER, AfterValidator(_inner_probability)]
GateProbability = Annotated[float, _NUMBER, AfterValidator(_gate_probability)]
Positive = Annotated[float, _NUMBER, AfterValidator(_positive), _within(1.0 / MAX_NUMBER, MAX_NUMBER)]
NotNegative = Annotated[float, _NUMBER, AfterValidator(_not_negative), _within(0.0, MAX_NUMBER)]
#: Coordinates, their derivatives, and other numbers of that order [m, m/s, m/s^2, rad/s].
Finite = Annotated[float, _NUMBER, AfterValidator(_finite), _within(-MAX_VALUE, MAX_VALUE)]
#: Standard deviations, lengths and speeds [m, rad, m/s, m/s^2].
Size = Annotated[float, _NUMBER, AfterValidator(_positive), _within(MIN_SIGMA, MAX_VALUE)]
Decibels = Annotated[float, _NUMBER, AfterValidator(_finite), _within(-300.0, 300.0)]
#: Areas and volumes [m^2, m^3].
Volume = Annotated[float, _NUMBER, AfterValidator(_positive), _within(MIN_SIGMA**3, MAX_VALUE**3)]
#: Times that pass [s].
Duration = Annotated[float, _NUMBER, AfterValidator(_positive), _within(MIN_SECONDS, MAX_SECONDS)]
Delay = Annotated[float, _NUMBER, AfterValidator(_not_negative), _within(0.0, MAX_SECONDS)]
Angle = Annotated[float, _NUMBER, AfterValidator(_angle)]
Span = Annotated[float, _NUMBER, AfterValidator(_span)]
Elevation = Annotated[float, _NUMBER, AfterValidator(_elevation)]
FalsePlots = Annotated[float, _NUMBER, AfterValidator(_false_plots), _within(MIN_FALSE_PLOTS, MAX_FALSE_PLOTS)]
Seconds = Annotated[float, _NUMBER, AfterValidator(_finite), AfterValidator(_seconds)]
Count = Annotated[int, Field(ge=0, strict=True)]
Instant = Annotated[datetime, BeforeValidator(_no_number), AfterValidator(_instant)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")]
