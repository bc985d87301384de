"""Notices: what the center tells everybody that somebody should look after; JSON, for people and for nodes."""

from __future__ import annotations

import json
from typing import Literal, NamedTuple, TypeAlias, get_args

from waldnet.common.errors import DecodeError

#: What a notice is about.
NoticeKind: TypeAlias = Literal["another scenario", "refused", "silent", "clock", "router"]


class Notice(NamedTuple):
    """One notice.

    Attributes:
        kind: what it is about.
        sensor: which sensor it concerns; empty: none, or several.
        text: one line for people.
        digest: of the scenario of a sensor that has another one.
        digests: of the parts of the center's scenario, by name, where sensors have another one.
    """

    kind: NoticeKind
    sensor: str
    text: str
    digest: str = ""
    digests: dict[str, str] = {}  # noqa: RUF012 (never changed)


def encode(notice: Notice) -> bytes:
    """A notice as bytes."""
    return json.dumps(notice._asdict()).encode()


def decode(key: str, payload: bytes) -> Notice:
    """Bytes as a notice.

    Raises:
        DecodeError: they are none.
    """
    try:
        notice = Notice(**json.loads(payload))
    except (ValueError, TypeError, RecursionError) as error:
        raise DecodeError(f"{key}: {len(payload)} bytes are no notice ({type(error).__name__})") from None
    texts = (notice.sensor, notice.text, notice.digest)
    if notice.kind not in get_args(NoticeKind) or not all(isinstance(text, str) for text in texts):
        raise DecodeError(f"{key}: {len(payload)} bytes are no notice")
    if not isinstance(notice.digests, dict):
        raise DecodeError(f"{key}: {len(payload)} bytes are no notice")
    return notice
