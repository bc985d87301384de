"""Reading JSON Lines: one object a line, blank lines skipped; what is wrong is said with file and line.

A file may be compressed with gzip, whatever its name is, and may begin with a byte order mark.
"""

from __future__ import annotations

import gzip
import json
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from waldnet.common.errors import WaldnetError
from waldnet.common.limits import MAX_ID, MAX_SECONDS, MAX_VALUE

T = TypeVar("T")

#: So many faults of a file are listed, the others counted.
_LISTED = 20
_GZIP = b"\x1f\x8b"


def read_lines(
    path: Path,
    what: str,
    keys: Sequence[str],
    parse: Callable[[dict[str, Any], int], T],
    failure: type[WaldnetError],
    optional: Sequence[str] | None = (),
) -> Iterator[T]:
    """Parse all lines of a file.

    Args:
        path: the file.
        what: a line is, for messages.
        keys: that every object must have.
        parse: makes something of an object and its line number; raises ValueError, saying what was got and expected.
        failure: raised for what is wrong.
        optional: keys that an object may have too; None for any.

    Yields:
        what was parsed, line by line, without the lines that are wrong.

    Raises:
        WaldnetError: after the last line: a ``failure`` naming file, line and reason of every fault, up to a bound.
    """
    faults = 0
    listed: list[str] = []
    for number, line in enumerate(_text(path, failure).splitlines(), start=1):
        if line.strip():
            try:
                parsed = parse(_object(line, what, keys, optional), number)
            except ValueError as error:
                faults += 1
                if faults <= _LISTED:
                    listed.append(f"{path}:{number}: {error}")
            else:
                yield parsed
    if faults > _LISTED:
        listed.append(f"{path}: {faults - _LISTED} more lines are wrong, {faults} in all")
    if faults:
        raise failure("\n".join(listed))


def _text(path: Path, failure: type[WaldnetError]) -> str:
    """The text of a file, decompressed, without a byte order mark."""
    try:
        content = path.read_bytes()
        if content.startswith(_GZIP):
            content = gzip.decompress(content)
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise failure(f"{path}: is no UTF-8 text: {error.reason} at byte {error.start}") from None
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise failure(f"{path}: is damaged, gzip cannot decompress it: {error}") from None
    except OSError as error:
        raise failure(f"{path}: cannot be read: {error.strerror}") from None


def _object(line: str, what: str, keys: Sequence[str], optional: Sequence[str] | None) -> dict[str, Any]:
    try:
        entry = json.loads(line)
    except json.JSONDecodeError as error:
        raise ValueError(f"is no JSON: {error.msg} at column {error.colno}") from None
    except RecursionError:
        raise ValueError(f"is no {what}: nested too deeply") from None
    if not isinstance(entry, dict):
        expected = f"{', '.join(keys[:-1])} and {keys[-1]}"
        raise ValueError(f"is a JSON {type(entry).__name__}, expected an object with {expected}")
    if missing := sorted(set(keys) - entry.keys()):
        raise ValueError(f"{missing[0]} is missing")
    if optional is not None and (unknown := sorted(entry.keys() - {*keys, *optional})):
        raise ValueError(f"{unknown[0]!r} is no known key; expected {', '.join(sorted({*keys, *optional}))}")
    return entry


def seconds(value: Any) -> float:
    """A time of a line, in seconds since the scenario's epoch.

    Raises:
        ValueError: for anything else.
    """
    if not _is_number(value) or abs(value) > MAX_SECONDS:
        unit = "; are these milliseconds, or nanoseconds?" if _is_number(value) else ""
        expected = f"a number of seconds between -{MAX_SECONDS:g} and {MAX_SECONDS:g}"
        raise ValueError(f"time: {value!r} is not {expected}{unit}")
    return float(value)


def identity(value: Any, where: str) -> int:
    """The number by which a line names a target or a track.

    Raises:
        ValueError: for anything else.
    """
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) > MAX_ID:
        raise ValueError(f"{where}: {value!r} is not a whole number between -{MAX_ID:g} and {MAX_ID:g}")
    return value


def numbers(value: Any, sizes: Sequence[int], where: str, largest: float = MAX_VALUE) -> list[float]:
    """A list of finite numbers, as long as one of the sizes, none beyond ``largest``.

    Raises:
        ValueError: for anything else.
    """
    if not isinstance(value, list) or len(value) not in sizes or not all(map(_is_number, value)):
        expected = " or ".join(map(str, sizes))
        raise ValueError(f"{where}: {value!r} is not a list of {expected} finite numbers")
    for number in value:
        if abs(number) > largest:
            raise ValueError(f"{where}: {number!r} is not between -{largest:g} and {largest:g}")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
