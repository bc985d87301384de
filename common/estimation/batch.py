"""Rows of a batch: a NamedTuple whose arrays, and batches, share their first axis."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Batch = TypeVar("Batch", bound=tuple[Any, ...])


def take(batch: Batch, rows: NDArray[Any]) -> Batch:
    """The chosen rows (a mask or indices) of every array; the batch itself where a mask chooses all."""
    if rows.dtype == np.bool_ and rows.all():
        return batch
    return type(batch)(*(take(part, rows) if isinstance(part, tuple) else part[rows] for part in batch))


def put(batch: Batch, rows: NDArray[Any], part: Batch) -> Batch:
    """The batch with the chosen rows replaced by those of ``part``."""

    def replaced(array: Any, new: Any) -> Any:
        if isinstance(array, tuple):
            return put(array, rows, new)
        copy = array.copy()
        copy[rows] = new
        return copy

    return type(batch)(*(replaced(array, new) for array, new in zip(batch, part, strict=True)))


def concatenate(first: Batch, second: Batch) -> Batch:
    """The rows of both, one after the other."""
    return type(first)(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))
