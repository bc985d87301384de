"""Bytes to messages and back: the only place where wire errors are born.

A payload is one msgpack array ``[version, kind, scalars, sizes, blocks]``: the scalars of the message in order, the
sizes of its array axes, and all arrays as raw little-endian blocks in one ``bin``. A report of 1000 tracks is decoded
without a loop over tracks. Covariances travel as their upper triangles, row by row. What a sensor says while it moves
or is turned has a sixth element, its velocity and heading. See docs/wire-format.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any, NamedTuple, TypeAlias, get_args, get_type_hints

import msgpack
import numpy as np
from numpy.typing import NDArray

from waldnet.common.errors import DecodeError, VersionError
from waldnet.common.estimation.sprt import Status
from waldnet.common.messages import (
    Advice,
    Begin,
    Clock,
    Decision,
    DecisionKind,
    Join,
    Keys,
    Message,
    Picked,
    Rebase,
    Report,
    Scan,
    Start,
    Stop,
    Tracks,
    sensor_of,
)

VERSION = 4


class Block(NamedTuple):
    """One array of a message.

    Attributes:
        field: its name in the message.
        dtype: on the wire, little-endian.
        axes: names of its axes; ``n^`` is a symmetric pair of axes n, sent as the upper triangle.
        kind: dtype in memory.
        relative: the positions that its rows begin with are sent relative to ``reference``, which no message has.
    """

    field: str
    dtype: str
    axes: tuple[str, ...]
    kind: str = "f8"
    relative: bool = False


class Rounding(NamedTuple):
    """How a report is sent in single precision: its positions relative to one near all of them.

    Attributes:
        dimensions: of a position, which states begin with.
        plots: whether plots are positions too.
    """

    dimensions: int
    plots: bool


def _floats(field: str, *axes: str) -> Block:
    return Block(field, "<f8", axes)


def _unclaimed(dtype: str, *, relative: bool = False) -> tuple[Block, ...]:
    return _floats("position", "d"), Block("unclaimed", dtype, ("U", "m"), relative=relative)


_IDS = Block("ids", "<u4", ("T",), "i8")
_SUPPORTED = Block("supported", "u1", ("L",), "?")
_TERMS = Block("terms", "u1", ("T",), "i8")
_BEGUN = (
    _IDS,
    Block("times_ns", "<i8", ("T",), "i8"),
    _floats("x", "T", "n"),
    _floats("P", "T", "n^"),
    Block("ended", "<u4", ("E",), "i8"),
)
_PICKED = (Block("plots", "<u2", ("T",), "i8"), Block("which", "<u2", ("N",), "i8"))

#: Where it is no more than a few times their distance from each other to them, single precision holds positions.
_REFERENCE = Block("reference", "<f4", ("r",))


def _rounded_report(*, plots: bool) -> tuple[type, tuple[Block, ...]]:
    """A report with rounded densities and plots, which may be positions; log g, which grows without end, is not."""
    densities = Block("x", "<f4", ("N", "n"), relative=True), Block("P", "<f4", ("N", "n^"))
    unclaimed = _unclaimed("<f4", relative=plots)
    return Report, (_IDS, _TERMS, _floats("log_g", "N"), *densities, *unclaimed, _REFERENCE, _SUPPORTED)


def _rounded_picked(*, plots: bool) -> tuple[type, tuple[Block, ...]]:
    """Picked plots, rounded, which may be positions."""
    z, reference = Block("z", "<f4", ("M", "m"), relative=plots), (_REFERENCE,) if plots else ()
    return Picked, (_IDS, *_PICKED, z, *_unclaimed("<f4", relative=plots), *reference)


#: Kinds of rounded reports, by their type and whether their plots are positions.
ROUNDED = {(Report, True): 10, (Report, False): 15, (Picked, True): 14, (Picked, False): 16}

#: Blocks of every kind of message; the number is the kind on the wire.
LAYOUTS: dict[int, tuple[type, tuple[Block, ...]]] = {
    1: (
        Report,
        (
            _IDS,
            _TERMS,
            _floats("log_g", "N"),
            _floats("x", "N", "n"),
            _floats("P", "N", "n^"),
            *_unclaimed("<f8"),
            _SUPPORTED,
        ),
    ),
    2: (Scan, (_floats("position", "d"), _floats("z", "M", "m"))),
    3: (Join, ()),
    4: (
        Start,
        (
            _IDS,
            Block("times_ns", "<i8", ("T",), "i8"),
            _floats("log_p_bar", "T"),
            _floats("x", "T", "n"),
            _floats("P", "T", "n^"),
            _floats("x_a", "T", "n"),
            _floats("P_a", "T", "n^"),
        ),
    ),
    5: (Stop, (_IDS,)),
    6: (Advice, (_IDS, _floats("x", "T", "n"), _floats("P", "T", "n^"))),
    7: (Clock, ()),
    8: (
        Tracks,
        (
            _IDS,
            Block("status", "u1", ("T",), "u1"),
            Block("scans", "<u4", ("T",), "i8"),
            Block("contributing", "u1", ("T", "S"), "?"),
            _floats("log_lr", "T"),
            _floats("log_lr_total", "T"),
            _floats("x", "T", "n"),
            _floats("P", "T", "n^"),
            Block("supported_ns", "<i8", ("T",), "i8"),
        ),
    ),
    9: (Decision, ()),
    11: (Begin, _BEGUN),
    13: (Picked, (_IDS, *_PICKED, _floats("z", "M", "m"), *_unclaimed("<f8"))),
    12: (Rebase, (_IDS, _floats("x", "T", "n"), _floats("P", "T", "n^"))),
    **{ROUNDED[Report, plots]: _rounded_report(plots=plots) for plots in (True, False)},
    **{ROUNDED[Picked, plots]: _rounded_picked(plots=plots) for plots in (True, False)},
}
_KINDS = {message: kind for kind, (message, _) in LAYOUTS.items() if kind not in ROUNDED.values()}
#: No state is larger; keeps a forged header from asking for memory.
_MAX_STATE = 64
#: Messages whose sensor is the one in the key.
_KEYED = (Report, Picked, Scan, Join, Start, Stop)
#: Messages that have a velocity and a heading, which are sent where they are not zero.
_POSED = (Report, Picked, Scan)
_POSE = ("velocity", "heading")
#: Scalars at the end of a message that are left out where all of them are zero.
_OPTIONAL: dict[type, int] = {Join: 2}
_MAX_SINGLE = float(np.finfo(np.float32).max)
#: Ids and epochs that a center could not count on from.
_MAX_ID, _MAX_EPOCH = 2**31, 2**62

_TO_WIRE: dict[str, Callable[[Any], Any]] = {"int": int, "float": float, "str": str, "tuple": list}
_EXPECTED = {"int": "a 64-bit integer", "float": "a finite float", "str": "a text", "tuple": "an array of texts"}

_AnyArray: TypeAlias = NDArray[Any]


def encode(message: Message, *, rounding: Rounding | None = None) -> bytes:
    """A message as bytes.

    Args:
        message: to send.
        rounding: how to send the densities or plots of a report in single precision; None: in double precision.

    Returns:
        the payload; the name of the sensor it comes from or goes to is in the key instead.
    """
    kind = _KINDS[type(message)]
    if rounding is not None:
        kind = ROUNDED.get((type(message), rounding.plots), kind)
    reference = _reference(message, kind, rounding.dimensions if rounding else 0)
    sizes: dict[str, int] = {}
    raw = []
    for block in LAYOUTS[kind][1]:
        array: _AnyArray = reference if block is _REFERENCE else getattr(message, block.field)
        if block.relative and len(array):
            array = array.copy()
            array[:, : len(reference)] -= reference
        for axis, size in zip(block.axes, array.shape, strict=False):
            assert sizes.setdefault(axis.rstrip("^"), size) == size, (
                f"{block.field} is not as long as others along {axis}"
            )
        if block.axes[-1].endswith("^"):
            array = _holding(array, block.dtype)[..., *_upper(array.shape[-1])]
        if block.dtype == "<f4":
            array = np.clip(array, -_MAX_SINGLE, _MAX_SINGLE)  # what is so large is of no use, but a number
        wire = np.ascontiguousarray(array, dtype=block.dtype)
        assert wire.dtype.kind != "u" or (wire == array).all(), f"{block.field} does not fit into {block.dtype}"
        raw.append(wire.tobytes())
    scalars = [_TO_WIRE[hint](getattr(message, name)) for name, hint in _scalars(kind)]
    optional = _OPTIONAL.get(type(message), 0)
    if optional and not any(scalars[-optional:]):
        del scalars[-optional:]
    return bytes(msgpack.packb([VERSION, kind, scalars, list(sizes.values()), b"".join(raw), *_pose(message)]))


def as_sent(report: Report | Picked, rounding: Rounding | None) -> Report | Picked:
    """A report as the center gets it: rounded, if it is rounded on the way."""
    if rounding is None:
        return report
    sent = decode(Keys("sent").of(report), encode(report, rounding=rounding))
    assert isinstance(sent, Report | Picked)
    return sent


def _reference(message: Message, kind: int, dimensions: int) -> _AnyArray:
    """A position near all that are sent relative to it, shape (d,); where there are none, shape (0,).

    It is one of single precision itself, and the median, so that one that is far off takes nothing from the others.
    """
    relative = [getattr(message, block.field)[:, :dimensions] for block in LAYOUTS[kind][1] if block.relative]
    places = [array for array in relative if len(array)]
    return np.median(np.concatenate(places), axis=0).astype("<f4").astype(np.float64) if places else np.empty(0)


def _holding(P: _AnyArray, dtype: str) -> _AnyArray:
    """Covariances so much larger that they stay positive definite when they are rounded, shape (..., n, n).

    Rounding moves an element by 2^-24 of itself at most, so the correlation matrix by n 2^-24 at most.
    """
    if dtype != "<f4":
        return P
    n = P.shape[-1]
    larger: _AnyArray = P * (1.0 + (n + 2.0) * 2.0**-24 * np.eye(n))
    return larger


def _pose(message: Message) -> list[bytes]:
    """Velocity and heading of a sensor that moves or is turned; otherwise nothing."""
    if not isinstance(message, _POSED) or (not len(message.velocity) and message.heading == 0.0):
        return []
    return [np.append(message.velocity, message.heading).astype("<f8").tobytes()]


def decode(key: str, payload: bytes) -> Message:
    """Bytes as a message.

    Args:
        key: where they came from; names the sensor, and the place in errors.
        payload: the bytes.

    Raises:
        VersionError: another wire version.
        DecodeError: anything else that is no message; never another exception.
    """
    try:
        version, body = _open(payload)
        if version != VERSION:
            raise VersionError(f"version {version}, this program reads {VERSION}")
        return _decode_body(sensor_of(key), body)
    except DecodeError as error:
        raise type(error)(f"{key}: {len(payload)} bytes are no message: {error}") from None


def _open(payload: bytes) -> tuple[int, list[Any]]:
    try:
        envelope = msgpack.unpackb(payload, use_list=True)
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        raise DecodeError(f"not msgpack ({type(error).__name__})") from None
    if not isinstance(envelope, list) or len(envelope) == 0 or not _is_int(envelope[0]):
        raise DecodeError("expected an array that starts with the version")
    return envelope[0], envelope[1:]


def _decode_body(sensor: str, body: list[Any]) -> Message:
    if len(body) not in (4, 5):
        raise DecodeError(f"{len(body) + 1} elements, expected 5: version, kind, scalars, sizes, blocks")
    kind, scalars, sizes, blocks, *pose = body
    if not _is_int(kind) or kind not in LAYOUTS:
        raise DecodeError(f"kind {_shown(kind)} is unknown")
    message = LAYOUTS[kind][0]
    fields = _decode_scalars(message, _scalars(kind), scalars)
    fields.update(_decode_blocks(kind, sizes, blocks))
    if pose:
        fields.update(_decode_pose(message, len(fields.get("position", ())), *pose))
    if message in _KEYED:
        if not sensor:
            raise DecodeError(f"a {message.__name__} does not belong on this key")
        fields["sensor"] = sensor
    decoded: Message = message(**fields)
    _check_numbers(decoded)
    _check_counts(decoded)
    return decoded


def _decode_scalars(message: type, expected: tuple[tuple[str, str], ...], scalars: Any) -> dict[str, Any]:
    if isinstance(scalars, list) and len(scalars) == len(expected) - _OPTIONAL.get(message, 0):
        expected = expected[: len(scalars)]
    if not isinstance(scalars, list) or len(scalars) != len(expected):
        raise DecodeError(f"expected the {len(expected)} scalars of a {message.__name__}")
    fields: dict[str, Any] = {}
    for (name, hint), value in zip(expected, scalars, strict=True):
        if hint == "tuple":
            good = isinstance(value, list) and all(isinstance(item, str) for item in value)
            fields[name] = tuple(value) if good else None
        elif hint == "int":
            good = _is_int(value) and -(2**63) <= value < 2**63
            fields[name] = value
        elif hint == "float":
            good = isinstance(value, float) and (
                math.isfinite(value) or (name.startswith("log_") and value == -math.inf)
            )
            fields[name] = value
        else:
            good = isinstance(value, str)
            fields[name] = value
        if not good:
            raise DecodeError(f"{name} is {_shown(value)}, expected {_EXPECTED[hint]}")
    return fields


def _decode_blocks(kind: int, sizes: Any, blocks: Any) -> dict[str, _AnyArray]:
    axes = _axes(kind)
    if not isinstance(sizes, list) or len(sizes) != len(axes) or not all(_is_int(size) and size >= 0 for size in sizes):
        raise DecodeError(f"expected the sizes of the axes {', '.join(axes) or '(none)'}")
    if not isinstance(blocks, bytes):
        raise DecodeError(f"blocks are a {type(blocks).__name__}, expected bin")
    most = max(_MAX_STATE, len(blocks))
    if any(size > (_MAX_STATE if axis == "n" else most) for axis, size in zip(axes, sizes, strict=True)):
        raise DecodeError(f"sizes {sizes} are larger than the {len(blocks)} bytes of blocks can hold")
    places, expected = _places(kind, tuple(sizes))
    if expected != len(blocks):
        raise DecodeError(f"{len(blocks)} bytes of blocks, expected {expected}")
    fields: dict[str, _AnyArray] = {}
    for block, place in zip(LAYOUTS[kind][1], places, strict=True):
        array = np.frombuffer(blocks, block.dtype, place.numbers, place.offset).astype(block.kind).reshape(place.shape)
        fields[block.field] = array if place.full is None else array[..., place.full]
    reference = fields.pop(_REFERENCE.field, np.empty(0))
    for block in LAYOUTS[kind][1]:
        if block.relative and len(array := fields[block.field]):
            if len(reference) > array.shape[1]:
                raise DecodeError(f"a reference of {len(reference)} numbers, {block.field} has {array.shape[1]}")
            array[:, : len(reference)] += reference
    return fields


def _decode_pose(message: type, d: int, pose: Any) -> dict[str, Any]:
    """Velocity and heading of a sensor whose place has ``d`` numbers."""
    if message not in _POSED:
        raise DecodeError(f"a {message.__name__} has 5 elements, not 6")
    sizes = sorted({8, 8 * (d + 1)})
    if not isinstance(pose, bytes) or len(pose) not in sizes:
        expected = " or ".join(map(str, sizes))
        raise DecodeError(f"velocity and heading are {_shown(pose)}, expected a bin of {expected} bytes")
    *velocity, heading = np.frombuffer(pose, "<f8").tolist()
    if not math.isfinite(heading):
        raise DecodeError(f"heading is {heading}, expected a finite float")
    return {"velocity": np.array(velocity, np.float64), "heading": heading}


class _Place(NamedTuple):
    """Where an array stands in the blocks.

    Attributes:
        offset: its first byte.
        numbers: how many there are.
        shape: as it stands there.
        full: of a triangle, for every element of the matrix its place in it.
    """

    offset: int
    numbers: int
    shape: tuple[int, ...]
    full: _AnyArray | None


@lru_cache(maxsize=512)
def _places(kind: int, sizes: tuple[int, ...]) -> tuple[tuple[_Place, ...], int]:
    """The places of all arrays of a message with axes of these sizes, and the bytes they take together."""
    size_of = dict(zip(_axes(kind), sizes, strict=True))
    places, offset = [], 0
    for block in LAYOUTS[kind][1]:
        triangle = block.axes[-1].endswith("^")
        shape = [size_of[axis.rstrip("^")] for axis in block.axes]
        full = _full(shape[-1]) if triangle else None
        if triangle:
            shape[-1] = shape[-1] * (shape[-1] + 1) // 2
        places.append(_Place(offset, math.prod(shape), tuple(shape), full))
        offset += math.prod(shape) * np.dtype(block.dtype).itemsize
    return tuple(places), offset


def _check_numbers(message: Message) -> None:
    """Finite numbers, ascending ids."""
    for name, value in message._asdict().items():
        if isinstance(value, np.ndarray) and value.dtype == np.float64 and not np.isfinite(value).all():
            # log p_bar of a scan that h1 holds for impossible is -inf.
            bad = np.isnan(value) | (value == np.inf) if name.startswith("log_") else ~np.isfinite(value)
            if bad.any():
                raise DecodeError(f"{name} has {int(bad.sum())} values that are not finite")
    for name in ("ids", "ended"):
        ids = getattr(message, name, None)
        if ids is not None and (ids[1:] <= ids[:-1]).any():
            raise DecodeError(f"{name} are not ascending")


def _check_counts(message: Message) -> None:
    """Counts that must agree, numbers that must stand for something."""
    match message:
        case Join(epoch=epoch, next_id=next_id) if not (0 <= epoch < _MAX_EPOCH and 0 <= next_id < _MAX_ID):
            raise DecodeError(f"epoch {epoch} or next_id {next_id} is none that a center could count on from")
        case Report(terms=terms, log_g=log_g) if (terms < 1).any() or terms.sum() != len(log_g):
            raise DecodeError(f"{int(terms.sum())} terms of tracks, {len(log_g)} terms sent")
        case Report(ids=ids, supported=supported) if len(supported) not in (0, len(ids)):
            raise DecodeError(f"{len(supported)} tracks supported or not, {len(ids)} tracks sent")
        case Picked(plots=plots, which=which, z=z) if plots.sum() != len(which) or (which >= len(z)).any():
            raise DecodeError(f"{int(plots.sum())} plots of tracks, {len(which)} places sent among {len(z)} plots")
        case Tracks(contributing=who, sensors=names) if who.shape[1] != len(names):
            raise DecodeError(f"{who.shape[1]} contributing sensors, {len(names)} names")
        case Tracks(status=status) if (status > max(Status)).any():
            raise DecodeError(f"status {int(status.max())} is unknown")
        case Decision(kind=kind) if kind not in get_args(DecisionKind):
            raise DecodeError(f"decision {_shown(kind)} is unknown")
        case _:
            pass


def _shown(value: Any) -> str:
    """A value for an error message, not longer than a line."""
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}... ({type(value).__name__})"


@cache
def _scalars(kind: int) -> tuple[tuple[str, str], ...]:
    """Names and types of the scalar fields of a kind of message, in order."""
    message, layout = LAYOUTS[kind]
    blocks = {block.field for block in layout}
    names = {int: "int", float: "float", tuple[str, ...]: "tuple"}
    return tuple(
        (name, names.get(hint, "str"))
        for name, hint in get_type_hints(message).items()
        if name not in (*blocks, *_POSE) and not (name == "sensor" and message in _KEYED)
    )


@cache
def _axes(kind: int) -> tuple[str, ...]:
    """Names of the axes of a kind of message, in the order in which they first appear."""
    return tuple(dict.fromkeys(axis.rstrip("^") for block in LAYOUTS[kind][1] for axis in block.axes))


@cache
def _full(n: int) -> _AnyArray:
    """For every element of a symmetric matrix, its place in the upper triangle, shape (n, n)."""
    rows, columns = np.indices((n, n))
    low, high = np.minimum(rows, columns), np.maximum(rows, columns)
    places: _AnyArray = low * n - low * (low - 1) // 2 + high - low
    return places


@cache
def _upper(n: int) -> tuple[_AnyArray, _AnyArray]:
    rows, columns = np.triu_indices(n)
    return rows, columns


def _is_int(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
