from __future__ import annotations

import tracemalloc
from typing import Any, get_args

import msgpack
import numpy as np
import pytest
from builders import same
from hypothesis import given, settings
from hypothesis import strategies as st

from waldnet.common.codec import LAYOUTS, ROUNDED, VERSION, Rounding, as_sent, decode, encode
from waldnet.common.errors import DecodeError, VersionError
from waldnet.common.estimation.gaussian import are_positive_definite
from waldnet.common.messages import (
    NEVER,
    Advice,
    Begin,
    Clock,
    Decision,
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

KEYS = Keys("coast")
EPOCH_NS = 1_767_225_600_000_000_000
FUZZ = settings(deadline=None, derandomize=True, max_examples=300, database=None)


def covariances(rng: np.random.Generator, count: int, n: int) -> Any:
    root = rng.standard_normal((count, n, n))
    return root @ root.mT + np.eye(n)


def ids(count: int) -> Any:
    return np.arange(count) * 3 + 1


def report(tracks: int, n: int = 4, terms: int = 1) -> Report:
    rng = np.random.default_rng(tracks)
    total = tracks * terms
    return Report(
        sensor="radar-1",
        sequence=7,
        time_ns=EPOCH_NS,
        next_ns=EPOCH_NS + 2_000_000_000,
        epoch=3,
        ids=ids(tracks),
        terms=np.full(tracks, terms),
        log_g=rng.standard_normal(total),
        x=rng.standard_normal((total, n)),
        P=covariances(rng, total, n),
    )


def with_unclaimed(message: Any, plots: int, m: int = 2, d: int = 2) -> Any:
    """A report or picked plots with plots that no track claims."""
    rng = np.random.default_rng(plots)
    return message._replace(position=rng.standard_normal(d), unclaimed=rng.standard_normal((plots, m)))


def moving(message: Any, d: int = 2) -> Any:
    """A message of a sensor that moves and is turned."""
    return message._replace(velocity=np.arange(1.0, d + 1.0), heading=-0.5)


def start(tracks: int, n: int = 4) -> Start:
    rng = np.random.default_rng(tracks)
    return Start(
        sensor="radar-1",
        epoch=3,
        ids=ids(tracks),
        times_ns=EPOCH_NS + np.arange(tracks),
        log_p_bar=rng.standard_normal(tracks),
        x=rng.standard_normal((tracks, n)),
        P=covariances(rng, tracks, n),
        x_a=rng.standard_normal((tracks, n)),
        P_a=covariances(rng, tracks, n),
        next_id=3 * tracks + 1,
    )


def begin(tracks: int, n: int = 4, ended: int = 2) -> Begin:
    rng = np.random.default_rng(tracks)
    return Begin(
        epoch=3,
        given_ns=EPOCH_NS,
        ids=ids(tracks),
        times_ns=EPOCH_NS - np.arange(tracks),
        x=rng.standard_normal((tracks, n)),
        P=covariances(rng, tracks, n),
        ended=ids(ended) + 1,
    )


def advice(tracks: int, n: int = 4) -> Advice:
    rng = np.random.default_rng(tracks)
    x, P = rng.standard_normal((tracks, n)), covariances(rng, tracks, n)
    return Advice(EPOCH_NS + 1, EPOCH_NS, ids(tracks), x, P)


def rebase(tracks: int, n: int = 4) -> Rebase:
    return Rebase(9, *advice(tracks, n))


def picture(tracks: int, n: int = 4, sensors: int = 3) -> Tracks:
    rng = np.random.default_rng(tracks)
    return Tracks(
        time_ns=EPOCH_NS,
        sensors=tuple(f"radar-{number}" for number in range(sensors)),
        ids=ids(tracks),
        status=rng.integers(0, 3, tracks).astype(np.uint8),
        scans=rng.integers(0, 100, tracks),
        contributing=rng.random((tracks, sensors)) < 0.5,
        log_lr=rng.standard_normal(tracks),
        log_lr_total=rng.standard_normal(tracks),
        x=rng.standard_normal((tracks, n)),
        P=covariances(rng, tracks, n),
        supported_ns=np.arange(tracks) + 1_700_000_000_000_000_000,
    )


def scan(plots: int, d: int = 2) -> Scan:
    rng = np.random.default_rng(plots)
    return Scan("radar-1", EPOCH_NS, rng.standard_normal(d), rng.standard_normal((plots, d)))


def picked(tracks: int, plots: int, m: int = 2) -> Picked:
    """Plot i goes to every track whose number is no multiple of i + 2."""
    rng = np.random.default_rng(tracks)
    which = [np.flatnonzero(track % np.arange(2, plots + 2)) for track in range(tracks)]
    return Picked(
        sensor="radar-1",
        sequence=3,
        time_ns=EPOCH_NS,
        next_ns=EPOCH_NS + 1,
        epoch=1,
        position=rng.standard_normal(m),
        ids=ids(tracks),
        plots=np.array([len(own) for own in which], np.int64),
        which=np.concatenate([np.empty(0, np.int64), *which]),
        z=rng.standard_normal((plots, m)),
        unclaimed=np.empty((0, m)),
    )


#: In 2-D, of a sensor whose plots are positions, and of another.
POSITIONS, POLAR = Rounding(2, plots=True), Rounding(2, plots=False)


MESSAGES: dict[str, Message] = {
    **{f"report-{t}": report(t) for t in (0, 1, 100)},
    "report-3d": report(2, n=6),
    "report-terms": report(5, terms=3),
    "report-mixed-terms": report(1, terms=6)._replace(ids=ids(3), terms=np.array([1, 2, 3])),
    "report-impossible": report(2)._replace(log_g=np.array([-np.inf, -1.0])),
    "report-last": report(1)._replace(next_ns=NEVER),
    **{f"report-unclaimed-{u}": with_unclaimed(report(1), u) for u in (0, 1, 100)},
    **{f"report-unclaimed-of-{m}": with_unclaimed(report(1), 2, m) for m in (1, 2, 3, 4)},
    "report-unclaimed-only": with_unclaimed(report(0), 2),
    "report-unclaimed-3d": with_unclaimed(report(2, n=6), 2, m=3, d=3),
    **{f"picked-{t}-{m}": picked(t, m) for t, m in ((0, 0), (1, 0), (1, 3), (100, 7))},
    "picked-3d": picked(3, 4, m=3),
    **{f"picked-unclaimed-{u}": with_unclaimed(picked(1, 3), u) for u in (0, 1, 100)},
    **{f"picked-unclaimed-of-{m}": with_unclaimed(picked(1, 3, m), 2, m) for m in (1, 2, 3, 4)},
    "picked-unclaimed-only": with_unclaimed(picked(0, 0), 2),
    "picked-unclaimed-3d": with_unclaimed(picked(2, 3, m=3), 2, m=3, d=3),
    **{f"scan-{m}": scan(m) for m in (0, 1, 100)},
    "scan-3d": scan(2, d=3),
    "scan-moving": moving(scan(1)),
    "scan-moving-3d": moving(scan(2, d=3), 3),
    "scan-at-rest": scan(1)._replace(velocity=np.zeros(2)),
    "scan-turned": scan(1)._replace(heading=6.25),
    "report-moving": moving(with_unclaimed(report(1), 1)),
    "report-turned-without-place": report(1)._replace(heading=0.25),
    "picked-moving": moving(with_unclaimed(picked(1, 3), 1)),
    "join": Join("radar-1", 2**63 - 1, EPOCH_NS, "0123456789abcdef"),
    "join-never": Join("radar-1", 0, NEVER, ""),
    "join-again": Join("radar-1", 1, NEVER, "", 2**61, 2**31 - 1),
    "join-of-an-epoch": Join("radar-1", 1, NEVER, "", 7, 0),
    **{f"start-{t}": start(t) for t in (0, 1, 100)},
    "start-3d": start(2, n=6),
    "start-last-of-all": start(1)._replace(next_id=NEVER),
    "start-impossible": start(1)._replace(log_p_bar=np.array([-np.inf])),
    **{f"begin-{t}": begin(t) for t in (0, 1, 100)},
    **{f"begin-ended-{e}": begin(1, ended=e) for e in (0, 1, 100)},
    "begin-nothing": begin(0, ended=0),
    "begin-3d": begin(2, n=6),
    **{f"stop-{t}": Stop("radar-1", ids(t)) for t in (0, 1, 100)},
    **{f"advice-{t}": advice(t) for t in (0, 1, 100)},
    "advice-3d": advice(2, n=6),
    **{f"rebase-{t}": rebase(t) for t in (0, 1, 100)},
    "rebase-3d": rebase(2, n=6),
    "clock": Clock(EPOCH_NS, EPOCH_NS + 1, 10.0, EPOCH_NS),
    "clock-never": Clock(-1, 0, 0.0, NEVER),
    **{f"tracks-{t}": picture(t) for t in (0, 1, 100)},
    "tracks-impossible": picture(1)._replace(log_lr=np.array([-np.inf]), log_lr_total=np.array([-np.inf])),
    "tracks-one-sensor": picture(2, sensors=1),
    "decision-confirmed": Decision("confirmed", 4, EPOCH_NS, 9.5, 11.0, 12),
    "decision-deleted": Decision("deleted", 4, EPOCH_NS, -np.inf, -np.inf, 1),
    "decision-merged": Decision("merged", 7, EPOCH_NS, 1.5, 1.5, 6, into=4),
    "decision-withdrawn": Decision("withdrawn", 4, EPOCH_NS, -3.5, -3.5, 2),
}
each_message = pytest.mark.parametrize("message", MESSAGES.values(), ids=MESSAGES.keys())


def refusal(payload: bytes, key: str | None = None) -> str:
    """Why a payload is refused."""
    with pytest.raises(DecodeError) as caught:
        decode(KEYS.report("radar-1") if key is None else key, payload)
    return str(caught.value)


def altered(message: Message, **changes: Any) -> bytes:
    """A message whose envelope was tampered with."""
    names = ("version", "kind", "scalars", "sizes", "blocks", "pose")
    parts = dict(zip(names, msgpack.unpackb(encode(message)), strict=False))
    return msgpack.packb(list({**parts, **changes}.values()))


def with_pose(message: Message, pose: Any) -> bytes:
    """A message with a sixth element."""
    return msgpack.packb([*msgpack.unpackb(encode(message)), pose])


@each_message
def test_a_message_comes_back_as_it_was_sent(message: Message) -> None:
    assert same(decode(KEYS.of(message), encode(message)), message)


@each_message
def test_a_message_takes_the_same_bytes_again(message: Message) -> None:
    payload = encode(message)
    assert encode(decode(KEYS.of(message), payload)) == payload


def test_every_type_of_message_has_a_layout_and_is_tested() -> None:
    types = set(get_args(Message))
    assert {message for message, _ in LAYOUTS.values()} == types
    assert {type(message) for message in MESSAGES.values()} == types


def test_arrays_that_come_back_can_be_written_to() -> None:
    decoded = decode(KEYS.report("radar-1"), encode(report(1)))
    assert isinstance(decoded, Report)
    assert all(array.flags.writeable for array in (decoded.ids, decoded.terms, decoded.log_g, decoded.x, decoded.P))


def test_arrays_may_be_laid_out_in_any_way() -> None:
    message = report(4)
    turned = message._replace(x=np.asfortranarray(message.x), P=message.P.mT, log_g=np.repeat(message.log_g, 2)[::2])
    assert encode(turned) == encode(message)


def test_the_name_of_the_sensor_is_the_keys() -> None:
    decoded = decode(KEYS.report("radar-2"), encode(report(1)))
    assert isinstance(decoded, Report)
    assert decoded.sensor == "radar-2"


GOLDEN_REPORT = Report(
    sensor="a",
    sequence=3,
    time_ns=10,
    next_ns=NEVER,
    epoch=2,
    ids=np.array([7]),
    terms=np.array([1]),
    log_g=np.array([-0.5]),
    x=np.array([[1.0, 2.0]]),
    P=np.array([[[4.0, 1.0], [1.0, 3.0]]]),
)
GOLDEN_START = Start(
    sensor="a",
    epoch=2,
    ids=np.array([7]),
    times_ns=np.array([258]),
    log_p_bar=np.array([-0.5]),
    x=np.array([[1.0, 2.0]]),
    P=np.array([[[4.0, 1.0], [1.0, 3.0]]]),
    x_a=np.array([[3.0, 4.0]]),
    P_a=np.array([[[2.0, 0.0], [0.0, 2.0]]]),
    next_id=9,
)
GOLDEN_UNCLAIMED = GOLDEN_REPORT._replace(position=np.array([5.0, 0.0]), unclaimed=np.array([[0.5, -2.0]]))
GOLDEN_PICKED = Picked(
    sensor="a",
    sequence=3,
    time_ns=10,
    next_ns=12,
    epoch=2,
    position=np.array([5.0, 0.0]),
    ids=np.array([7]),
    plots=np.array([1]),
    which=np.array([0]),
    z=np.array([[1.0, 2.0]]),
    unclaimed=np.array([[0.5, -2.0]]),
)
GOLDEN_BEGIN = Begin(
    epoch=2,
    given_ns=12,
    ids=np.array([7]),
    times_ns=np.array([258]),
    x=np.array([[1.0, 2.0]]),
    P=np.array([[[4.0, 1.0], [1.0, 3.0]]]),
    ended=np.array([5, 6]),
)
GOLDEN_ADVICE = Advice(
    given_ns=12,
    time_ns=10,
    ids=np.array([7]),
    x=np.array([[1.0, 2.0]]),
    P=np.array([[[4.0, 1.0], [1.0, 3.0]]]),
)
GOLDEN = [
    (
        GOLDEN_REPORT,
        "95 04 01"  # version, kind
        "94 03 0a cf7fffffffffffffff 02"  # sequence, time, next, epoch
        "97 01 01 02 00 00 00 00"  # T, N, n, d, U, m, L
        "c4 35 07000000 01"  # bin; ids, terms
        "000000000000e0bf"  # log_g
        "000000000000f03f 0000000000000040"  # x
        "0000000000001040 000000000000f03f 0000000000000840",  # upper triangle of P
    ),
    (
        GOLDEN_UNCLAIMED,
        "95 04 01 94 03 0a cf7fffffffffffffff 02"  # as before
        "97 01 01 02 02 01 02 00"  # T, N, n, d, U, m, L
        "c4 55 07000000 01 000000000000e0bf 000000000000f03f 0000000000000040"
        "0000000000001040 000000000000f03f 0000000000000840"
        "0000000000001440 0000000000000000"  # position
        "000000000000e03f 00000000000000c0",  # unclaimed
    ),
    (
        GOLDEN_PICKED,
        "95 04 0d 94 03 0a 0c 02"  # version, kind, sequence, time, next, epoch
        "96 01 01 01 02 02 01"  # T, N, M, m, d, U
        "c4 38 07000000 0100 0000"  # bin; ids, plots, which
        "000000000000f03f 0000000000000040"  # z
        "0000000000001440 0000000000000000"  # position
        "000000000000e03f 00000000000000c0",  # unclaimed
    ),
    (
        GOLDEN_START,
        "95 04 04 92 02 09 92 01 02"  # version, kind, epoch, next id, T, n
        "c4 64 07000000 0201000000000000"  # bin; ids, times
        "000000000000e0bf"  # log_p_bar
        "000000000000f03f 0000000000000040 0000000000001040 000000000000f03f 0000000000000840"  # x, P
        "0000000000000840 0000000000001040 0000000000000040 0000000000000000 0000000000000040",  # x_a, P_a
    ),
    (
        GOLDEN_BEGIN,
        "95 04 0b 92 02 0c 93 01 02 02"  # version, kind, epoch, given, T, n, E
        "c4 3c 07000000 0201000000000000"  # bin; ids, times
        "000000000000f03f 0000000000000040 0000000000001040 000000000000f03f 0000000000000840"  # x, P
        "05000000 06000000",  # ended
    ),
    (
        GOLDEN_ADVICE,
        "95 04 06 92 0c 0a 92 01 02"  # version, kind, given, time, T, n
        "c4 2c 07000000"  # bin; ids
        "000000000000f03f 0000000000000040 0000000000001040 000000000000f03f 0000000000000840",  # x, P
    ),
    (
        Rebase(5, *GOLDEN_ADVICE),
        "95 04 0c 93 05 0c 0a 92 01 02"  # version, kind, epoch, given, time, T, n
        "c4 2c 07000000"  # bin; ids
        "000000000000f03f 0000000000000040 0000000000001040 000000000000f03f 0000000000000840",  # x, P
    ),
    (
        Join("a", 1, 10, "0f"),
        "95 04 03 93 01 0a a2 3066 90 c400",  # version, kind, incarnation, next, digest
    ),
    (
        Join("a", 1, 10, "0f", 7, 9),
        "95 04 03 95 01 0a a2 3066 07 09 90 c400",  # epoch and next id of a node that has heard of any
    ),
    (
        Decision("merged", 7, 10, 0.5, 2.0, 12, into=4),
        "95 04 09 97 a66d6572676564 07 0a"  # version, kind, what, track, time
        "cb3fe0000000000000 cb4000000000000000 0c 04 90 c400",  # log_lr, log_lr_total, scans, into
    ),
]


#: Velocity and heading stand behind the bytes of a message of a sensor that stands still and heads north.
GOLDEN_MOVING = [
    (
        Scan("a", 10, np.array([5.0, 0.0]), np.array([[1.0]]), np.array([2.0, -4.0]), 0.5),
        "96 04 02 91 0a 93 02 01 01"  # version, kind, time, d, M, m
        "c4 18 0000000000001440 0000000000000000 000000000000f03f"  # bin; position, z
        "c4 18 0000000000000040 00000000000010c0 000000000000e03f",  # bin; velocity, heading
    ),
    (
        Scan("a", 10, np.array([5.0, 0.0]), np.array([[1.0]]), heading=0.5),
        "96 04 02 91 0a 93 02 01 01 c4 18 0000000000001440 0000000000000000 000000000000f03f"
        "c4 08 000000000000e03f",  # bin; heading
    ),
]


@pytest.mark.parametrize(("message", "golden"), GOLDEN_MOVING, ids=["moving", "turned"])
def test_the_bytes_of_a_sensor_that_moves_never_change(message: Message, golden: str) -> None:
    payload = bytes.fromhex(golden)
    assert encode(message) == payload
    assert same(decode(KEYS.of(message), payload), message)


def test_a_pose_adds_itself_to_the_bytes_and_nothing_else() -> None:
    for still in (scan(3), with_unclaimed(report(2), 1), picked(2, 3)):
        before, after = (msgpack.unpackb(encode(message)) for message in (still, moving(still)))
        assert after[:5] == before
        assert len(after[5]) == 24


GOLDEN_ROUNDED = [
    (
        GOLDEN_UNCLAIMED,
        POSITIONS,
        "95 04 0a 94 03 0a cf7fffffffffffffff 02 98 01 01 02 02 01 02 02 00"
        "c4 41 07000000 01 000000000000e0bf"  # log_g in full
        "0000803e 00000040 02008040 0000803f 03004040"  # x, P
        "0000000000001440 0000000000000000"  # position in full
        "000080be 000000c0"  # unclaimed
        "0000403f 00000000",  # reference
    ),
    (
        GOLDEN_PICKED,
        POSITIONS,
        "95 04 0e 94 03 0a 0c 02 97 01 01 01 02 02 01 02"
        "c4 30 07000000 0100 0000 0000803e 00000040"  # z
        "0000000000001440 0000000000000000"  # position in full
        "000080be 000000c0"  # unclaimed
        "0000403f 00000000",  # reference
    ),
    (
        GOLDEN_UNCLAIMED,
        POLAR,
        "95 04 0f 94 03 0a cf7fffffffffffffff 02 98 01 01 02 02 01 02 02 00"
        "c4 41 07000000 01 000000000000e0bf"  # log_g in full
        "00000000 00000000 02008040 0000803f 03004040"  # x, P
        "0000000000001440 0000000000000000"  # position in full
        "0000003f 000000c0"  # unclaimed
        "0000803f 00000040",  # reference
    ),
    (
        GOLDEN_PICKED,
        POLAR,
        "95 04 10 94 03 0a 0c 02 96 01 01 01 02 02 01"
        "c4 28 07000000 0100 0000 0000803f 00000040"  # z
        "0000000000001440 0000000000000000"  # position in full
        "0000003f 000000c0",  # unclaimed
    ),
]


@pytest.mark.parametrize(("message", "rounding", "golden"), GOLDEN_ROUNDED)
def test_the_bytes_of_a_rounded_report_never_change(message: Message, rounding: Rounding, golden: str) -> None:
    payload = bytes.fromhex(golden)
    assert encode(message, rounding=rounding) == payload
    got = decode(KEYS.of(message), payload)
    if isinstance(got, Report):
        # Five in 2^24 larger, so that it stays positive definite.
        np.testing.assert_allclose(got.P, message.P, rtol=5 * 2.0**-24)
        got = got._replace(P=message.P)
    assert same(got, message)


GOLDEN_NAMES = ["report", "unclaimed", "picked", "start", "begin", "advice", "rebase", "join", "join again", "merged"]


@pytest.mark.parametrize(("message", "golden"), GOLDEN, ids=GOLDEN_NAMES)
def test_the_bytes_of_version_4_never_change(message: Message, golden: str) -> None:
    payload = bytes.fromhex(golden)
    assert encode(message) == payload
    assert same(decode(KEYS.of(message), payload), message)


#: Bytes per track, plot or term at 100 of them, 2-D and three sensors: one more number in a message breaks its budget.
BUDGETS = {
    "report": 126,
    "tracks": 150,
    "start": 245,
    "advice": 117,
    "rebase": 117,
    "begin": 125,
    "report-unclaimed": 18,
    "picked-unclaimed": 18,
    "scan": 17,
    "stop": 5,
}


@pytest.mark.parametrize(("name", "budget"), BUDGETS.items())
def test_a_message_keeps_its_budget(name: str, budget: int) -> None:
    assert len(encode(MESSAGES[f"{name}-100"])) <= budget * 100


def test_a_rounded_report_keeps_its_budget() -> None:
    assert len(encode(report(100), rounding=POSITIONS)) <= 70 * 100


@pytest.mark.parametrize(
    ("less", "more", "double", "single"),
    [
        (report(100), report(101), 125, 69),
        (report(100, n=6), report(101, n=6), 229, 121),
        (with_unclaimed(report(1), 50), with_unclaimed(report(1), 51), 16, 8),
        (with_unclaimed(report(1), 50, m=3, d=3), with_unclaimed(report(1), 51, m=3, d=3), 24, 12),
        (with_unclaimed(picked(1, 3), 50), with_unclaimed(picked(1, 3), 51), 16, 8),
        (begin(100), begin(101), 124, 124),
        (begin(2, ended=50), begin(2, ended=51), 4, 4),
    ],
)
def test_one_more_takes_so_many_bytes(less: Message, more: Message, double: int, single: int) -> None:
    assert len(encode(more)) - len(encode(less)) == double
    assert len(encode(more, rounding=POSITIONS)) - len(encode(less, rounding=POSITIONS)) == single


def test_small_messages_keep_their_budgets() -> None:
    assert len(encode(MESSAGES["clock"])) <= 45
    assert len(encode(MESSAGES["join"])) <= 45
    assert len(encode(MESSAGES["decision-confirmed"])) <= 50


REPORTS = {
    name: message
    for name, message in MESSAGES.items()
    if isinstance(message, Report | Picked) and not name.endswith("of-1")  # a position has two numbers
}


@pytest.mark.parametrize("message", REPORTS.values(), ids=REPORTS.keys())
@pytest.mark.parametrize("rounding", [POSITIONS, POLAR])
@pytest.mark.parametrize("at", [0.0, 3.9e6, -1e9])
def test_a_rounded_report_keeps_its_evidence_and_what_lies_near(
    message: Report | Picked, rounding: Rounding, at: float
) -> None:
    """Numbers are of a unit's size, and positions around ``at``."""
    message = shifted(message, rounding, at)
    payload = encode(message, rounding=rounding)
    assert msgpack.unpackb(payload)[1] == ROUNDED[type(message), rounding.plots]
    got = decode(KEYS.of(message), payload)
    for name in message._fields:
        sent, came = getattr(message, name), getattr(got, name)
        if name in ("x", "z", "unclaimed"):
            np.testing.assert_allclose(came, sent, rtol=0.0, atol=1e-6)
        elif name == "P":
            np.testing.assert_allclose(came, sent, rtol=2.0**-20)
        else:
            assert np.array_equal(came, sent)


def shifted(message: Report | Picked, rounding: Rounding, at: float) -> Report | Picked:
    """A report whose positions are somewhere else."""
    names = ["x", "z", "unclaimed"] if rounding.plots else ["x"]
    arrays = {name: getattr(message, name).copy() for name in names if hasattr(message, name)}
    for array in arrays.values():
        array[:, : rounding.dimensions] += at
    return message._replace(**arrays)


def test_a_position_far_off_takes_nothing_from_the_others() -> None:
    message = shifted(report(5), POLAR, 3.9e6)
    message.x[2, 0] = 1e15
    got = as_sent(message, POLAR)
    assert isinstance(got, Report)
    near = np.arange(5) != 2
    assert np.abs(got.x - message.x)[near].max() < 1e-5


@settings(deadline=None, derandomize=True, database=None)
@given(st.integers(0, 10**6), st.floats(0.0, 15.0), st.integers(2, 9))
def test_a_rounded_covariance_stays_positive_definite(seed: int, digits: float, n: int) -> None:
    """However large the correlations, which rounding alone takes beyond one."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n)) * 10.0 ** -rng.uniform(0.0, digits, n)
    P = A @ A.T + 1e-13 * np.diag(np.diag(A @ A.T))
    message = report(1, n=n)._replace(P=P[None], x=np.zeros((1, n)))
    got = as_sent(message, POLAR)
    assert isinstance(got, Report)
    assert are_positive_definite(got.P).all()
    np.testing.assert_allclose(np.diag(got.P[0]), np.diag(P), rtol=1e-5)


def test_a_reference_of_too_many_numbers_is_no_message() -> None:
    envelope = msgpack.unpackb(encode(report(2), rounding=POLAR))
    envelope[3][-2] = 5
    envelope[4] += bytes(4 * 3)
    with pytest.raises(DecodeError, match="a reference of 5 numbers, x has 4"):
        decode(KEYS.report("radar-1"), msgpack.packb(envelope))


def test_only_reports_are_rounded() -> None:
    others = [message for message in MESSAGES.values() if not isinstance(message, Report | Picked)]
    assert all(encode(message, rounding=POSITIONS) == encode(message) for message in others)


UNLIKE = [
    (report(2), "x", np.zeros((3, 4)), "x is not as long as others along N"),
    (report(2), "P", np.zeros((2, 3, 3)), "P is not as long as others along n"),
    (report(2), "terms", np.ones(1, np.int64), "terms is not as long as others along T"),
    (picked(1, 3), "unclaimed", np.zeros((1, 3)), "unclaimed is not as long as others along m"),
    (begin(2), "times_ns", np.zeros(1, np.int64), "times_ns is not as long as others along T"),
]


@pytest.mark.parametrize(("message", "name", "value", "fault"), UNLIKE)
def test_arrays_along_one_axis_are_equally_long(message: Message, name: str, value: Any, fault: str) -> None:
    with pytest.raises(AssertionError, match=fault):
        encode(message._replace(**{name: value}))


@pytest.mark.parametrize("version", [0, VERSION - 1, VERSION + 1, 7, -1, 2**64 - 1])
def test_another_version_is_refused_whatever_follows(version: int) -> None:
    for payload in (msgpack.packb([version]), altered(report(1), version=version)):
        with pytest.raises(VersionError) as caught:
            decode(KEYS.report("radar-1"), payload)
        assert str(caught.value) == (
            f"waldnet/coast/sensor/radar-1/report: {len(payload)} bytes are no message: "
            f"version {version}, this program reads {VERSION}"
        )


@pytest.mark.parametrize(
    "message", [report(1), picked(1, 1), scan(1), MESSAGES["join"], start(1), Stop("radar-1", ids(1))]
)
def test_a_message_about_a_sensor_needs_a_key_with_one(message: Message) -> None:
    key = "waldnet/coast/center/tracks"
    payload = encode(message)
    assert refusal(payload, key) == (
        f"{key}: {len(payload)} bytes are no message: a {type(message).__name__} does not belong on this key"
    )


def floats(message: Message) -> list[str]:
    return [
        name
        for name, value in message._asdict().items()
        if isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype == np.float64)
    ]


FLOATS = [
    (message, name)
    for message in (
        moving(with_unclaimed(report(1), 1)),
        moving(with_unclaimed(picked(1, 1), 1)),
        moving(scan(1)),
        start(1),
        begin(1),
        advice(1),
        rebase(1),
        picture(1),
    )
    for name in floats(message)
    if name != "heading"
]
FLOAT_NAMES = [f"{type(message).__name__}.{name}" for message, name in FLOATS]


@pytest.mark.parametrize(("message", "name"), FLOATS, ids=FLOAT_NAMES)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_arrays_with_nan_or_infinity_are_refused(message: Message, name: str, value: float) -> None:
    bad = getattr(message, name).copy()
    bad.flat[0] = value
    payload = encode(message._replace(**{name: bad}))
    assert f"{name} has 1 values that are not finite" in refusal(payload, KEYS.of(message))


@pytest.mark.parametrize("name", ["x", "P", "position", "unclaimed"])
def test_minus_infinity_is_only_for_logarithms(name: str) -> None:
    message = with_unclaimed(report(1), 1)
    bad = getattr(message, name).copy()
    bad.flat[0] = -np.inf
    assert "not finite" in refusal(encode(message._replace(**{name: bad})))


SCALARS = [
    (message, name) for message in (MESSAGES["clock"], MESSAGES["decision-confirmed"]) for name in floats(message)
]


@pytest.mark.parametrize(("message", "name"), SCALARS, ids=[f"{type(m).__name__}.{name}" for m, name in SCALARS])
def test_scalars_that_are_nan_are_refused(message: Message, name: str) -> None:
    assert name in refusal(encode(message._replace(**{name: float("nan")})), KEYS.of(message))


@pytest.mark.parametrize("message", [moving(scan(1)), moving(with_unclaimed(report(1), 1)), moving(picked(1, 1))])
def test_a_heading_that_is_nan_is_refused(message: Any) -> None:
    payload = encode(message._replace(heading=float("nan")))
    assert "heading is nan, expected a finite float" in refusal(payload, KEYS.of(message))


@pytest.mark.parametrize("numbers", [(-1, 0), (0, -1), (2**62, 0), (0, 2**31), (2**63 - 1, 2**63 - 1)])
def test_epochs_and_ids_that_a_center_could_not_count_on_from_are_refused(numbers: tuple[int, int]) -> None:
    payload = altered(Join("radar-1", 1, 2, ""), scalars=[1, 2, "", *numbers])
    assert "none that a center could count on from" in refusal(payload, KEYS.join("radar-1"))


BLOCKS = msgpack.unpackb(encode(GOLDEN_REPORT))[4]
ENVELOPES = [
    ("nothing", b"", "not msgpack"),
    ("no msgpack", b"\xc1", "not msgpack"),
    ("more after it", encode(report(1)) + b"\x00", "not msgpack"),
    ("no array", msgpack.packb({"version": 1}), "expected an array that starts with the version"),
    ("empty array", msgpack.packb([]), "expected an array that starts with the version"),
    ("version as text", msgpack.packb(["1"]), "expected an array that starts with the version"),
    ("version as truth", msgpack.packb([True]), "expected an array that starts with the version"),
    ("too short", msgpack.packb([VERSION, 1]), "2 elements, expected 5: version, kind, scalars, sizes, blocks"),
    ("too long", msgpack.packb([VERSION, 1, [], [], b"", b"", 0]), "7 elements, expected 5"),
    (
        "a pose that is no bin",
        with_pose(GOLDEN_UNCLAIMED, 0.5),
        "heading are 0.5, expected a bin of 8 or",
    ),
    ("a pose of 3-D", with_pose(GOLDEN_UNCLAIMED, bytes(32)), "expected a bin of 8 or 24 bytes"),
    ("a pose of nothing", with_pose(GOLDEN_UNCLAIMED, b""), "velocity and heading are b'', expected a bin of 8 or 24"),
    ("a velocity of no place", with_pose(GOLDEN_REPORT, bytes(24)), "expected a bin of 8 bytes"),
    ("a pose of no sensor", with_pose(MESSAGES["tracks-1"], bytes(8)), "a Tracks has 5 elements, not 6"),
    ("kind unknown", altered(GOLDEN_REPORT, kind=99), "kind 99 is unknown"),
    ("kind as truth", altered(GOLDEN_REPORT, kind=True), "kind True is unknown"),
    ("scalars missing", altered(GOLDEN_REPORT, scalars=[1, 2]), "expected the 4 scalars of a Report"),
    ("scalars no list", altered(GOLDEN_REPORT, scalars=4), "expected the 4 scalars of a Report"),
    ("time as float", altered(GOLDEN_REPORT, scalars=[0, 1.0, 2, 1]), "time_ns is 1.0, expected a 64-bit integer"),
    ("epoch as truth", altered(GOLDEN_REPORT, scalars=[0, 1, 2, True]), "epoch is True, expected a 64-bit integer"),
    ("time too large", altered(GOLDEN_REPORT, scalars=[0, 2**63, 2, 1]), "time_ns is "),
    ("sizes missing", altered(GOLDEN_REPORT, sizes=[1, 1, 2]), "expected the sizes of the axes T, N, n, d, U, m"),
    ("size negative", altered(GOLDEN_REPORT, sizes=[1, -1, 2, 0, 0, 0]), "expected the sizes of the axes T, N, n"),
    ("size as truth", altered(GOLDEN_REPORT, sizes=[True, 1, 2, 0, 0, 0]), "expected the sizes of the axes T, N, n"),
    ("sizes of a join", altered(MESSAGES["join"], sizes=[1]), "expected the sizes of the axes (none)"),
    ("blocks as text", altered(GOLDEN_REPORT, blocks="x" * 53), "blocks are a str, expected bin"),
    ("blocks too short", altered(GOLDEN_REPORT, blocks=BLOCKS[:-1]), "52 bytes of blocks, expected 53"),
    ("blocks too long", altered(GOLDEN_REPORT, blocks=BLOCKS + b"\0"), "54 bytes of blocks, expected 53"),
    (
        "size forged",
        altered(GOLDEN_REPORT, sizes=[2**32, 1, 2, 0, 0, 0, 0]),
        "larger than the 53 bytes of blocks can hold",
    ),
    (
        "state forged",
        altered(GOLDEN_REPORT, sizes=[1, 1, 65, 0, 0, 0, 0]),
        "larger than the 53 bytes of blocks can hold",
    ),
    ("unclaimed forged", altered(GOLDEN_REPORT, sizes=[1, 1, 2, 0, 2**40, 0, 0]), "larger than the 53 bytes of blocks"),
    ("unclaimed not sent", altered(GOLDEN_REPORT, sizes=[1, 1, 2, 2, 1, 2, 0]), "53 bytes of blocks, expected 85"),
    ("ids descending", encode(report(2)._replace(ids=np.array([5, 4]))), "ids are not ascending"),
    ("ids repeated", encode(report(2)._replace(ids=np.array([5, 5]))), "ids are not ascending"),
    ("track without term", encode(report(2)._replace(terms=np.array([2, 0]))), "2 terms of tracks, 2 terms sent"),
    ("terms missing", encode(report(2)._replace(terms=np.array([2, 1]))), "3 terms of tracks, 2 terms sent"),
]


@pytest.mark.parametrize(("payload", "reason"), [case[1:] for case in ENVELOPES], ids=[case[0] for case in ENVELOPES])
def test_what_is_wrong_is_said(payload: bytes, reason: str) -> None:
    text = refusal(payload)
    assert text.startswith(f"waldnet/coast/sensor/radar-1/report: {len(payload)} bytes are no message: ")
    assert reason in text


@pytest.mark.parametrize("sensors", [["radar-1", 2, "radar-3"], "abc", None])
def test_sensors_that_are_no_names_are_refused(sensors: Any) -> None:
    payload = altered(MESSAGES["tracks-1"], scalars=[EPOCH_NS, sensors])
    assert f"sensors is {sensors!r}, expected an array of texts" in refusal(payload, KEYS.tracks())


def test_tracks_that_ended_ascend() -> None:
    message = begin(1)._replace(ended=np.array([5, 5]))
    assert "ended are not ascending" in refusal(encode(message), KEYS.of(message))


def test_an_unknown_decision_is_refused() -> None:
    scalars = ["perhaps", 4, EPOCH_NS, 1.0, 1.0, 1, -1]
    assert "decision 'perhaps' is unknown" in refusal(altered(MESSAGES["decision-deleted"], scalars=scalars), "k")


def test_tracks_have_one_column_per_sensor() -> None:
    refusal(encode(picture(2, sensors=3)._replace(sensors=("radar-1",))), KEYS.tracks())


def test_an_unknown_status_is_refused() -> None:
    refusal(encode(picture(1)._replace(status=np.array([4], np.uint8))), KEYS.tracks())


def test_a_refusal_is_short_whatever_was_sent() -> None:
    assert len(refusal(msgpack.packb([VERSION, "x" * 100_000, [], [], b""]))) < 1000


# Fuzzed bytes ---------------------------------------------------------------------------------------------------------


def survives(key: str, payload: bytes) -> None:
    """Bytes are a message or a DecodeError, take little memory, and a message encodes to bytes that decode to it."""
    tracemalloc.start()
    try:
        message = decode(key, payload)
    except DecodeError as error:
        assert str(error).startswith(f"{key}: {len(payload)} bytes")
    else:
        assert same(decode(key, encode(message)), message)
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < 1_000_000 + 100 * len(payload)


any_key = st.sampled_from([KEYS.of(message) for message in MESSAGES.values()] + ["", "waldnet/coast/center/picture"])
any_message = st.sampled_from([message for name, message in MESSAGES.items() if not name.endswith("100")])
any_int = st.integers(-(2**63), 2**64 - 1)
scalar = st.none() | st.booleans() | any_int | st.floats() | st.text(max_size=8) | st.binary(max_size=64)
structure = st.recursive(
    scalar,
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(max_size=3) | any_int, inner, max_size=3),
    max_leaves=12,
)
size = st.integers(0, 70) | st.integers(0, 2**64 - 1)


@FUZZ
@given(any_key, st.binary(max_size=300))
def test_random_bytes(key: str, payload: bytes) -> None:
    survives(key, payload)


TRUNCATED = [
    "report-1",
    "report-unclaimed-1",
    "picked-unclaimed-1",
    "scan-1",
    "join",
    "start-1",
    "begin-1",
    "stop-1",
    "advice-1",
    "rebase-1",
    "clock",
    "tracks-1",
    "decision-merged",
]


@pytest.mark.parametrize("name", TRUNCATED)
def test_truncated_bytes(name: str) -> None:
    message = MESSAGES[name]
    payload = encode(message)
    for length in range(len(payload)):
        refusal(payload[:length], KEYS.of(message))


@FUZZ
@given(any_message, st.lists(st.integers(0, 2**20), min_size=1, max_size=3))
def test_flipped_bits(message: Message, bits: list[int]) -> None:
    payload = bytearray(encode(message))
    for bit in bits:
        at = bit % (8 * len(payload))
        payload[at // 8] ^= 1 << at % 8
    survives(KEYS.of(message), bytes(payload))


@FUZZ
@given(any_key, structure)
def test_random_structures(key: str, content: Any) -> None:
    survives(key, msgpack.packb(content))


@FUZZ
@given(any_key, st.integers(0, max(LAYOUTS) + 1), structure, structure, structure)
def test_random_bodies(key: str, kind: int, scalars: Any, sizes: Any, blocks: Any) -> None:
    survives(key, msgpack.packb([VERSION, kind, scalars, sizes, blocks]))


@FUZZ
@given(any_message, st.lists(size, max_size=7), st.none() | st.binary(max_size=200))
def test_forged_sizes(message: Message, sizes: list[int], blocks: bytes | None) -> None:
    changes = {} if blocks is None else {"blocks": blocks}
    survives(KEYS.of(message), altered(message, sizes=sizes, **changes))


@pytest.mark.parametrize("header", [b"\x91", b"\x81\xa1a", b"\x92\x01"])
def test_deep_nesting(header: bytes) -> None:
    survives("k", header * 100_000)


@pytest.mark.parametrize(
    "header", [b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xc9\xff\xff\xff\xff"]
)
def test_forged_lengths_of_msgpack(header: bytes) -> None:
    survives("k", header)
    survives("k", b"\x92\x01" + header)


# Keys -----------------------------------------------------------------------------------------------------------------


def test_every_message_has_its_key() -> None:
    keys = {type(message).__name__: KEYS.of(message) for message in MESSAGES.values()}
    assert keys == {
        "Report": "waldnet/coast/sensor/radar-1/report",
        "Picked": "waldnet/coast/sensor/radar-1/report",
        "Scan": "waldnet/coast/sensor/radar-1/plots",
        "Join": "waldnet/coast/sensor/radar-1/join",
        "Start": "waldnet/coast/center/command/radar-1",
        "Stop": "waldnet/coast/center/command/radar-1",
        "Begin": "waldnet/coast/center/advice",
        "Advice": "waldnet/coast/center/advice",
        "Rebase": "waldnet/coast/center/advice",
        "Clock": "waldnet/coast/center/clock",
        "Tracks": "waldnet/coast/center/tracks",
        "Decision": "waldnet/coast/center/decision",
    }


@pytest.mark.parametrize(
    ("key", "sensor"),
    [
        (KEYS.report("radar-1"), "radar-1"),
        (KEYS.about("radar-1"), "radar-1"),
        (KEYS.command("radar-1"), "radar-1"),
        (KEYS.sensor_alive("radar-1"), "radar-1"),
        (KEYS.center_alive(), ""),
        (KEYS.clock(), ""),
        (KEYS.picture(), ""),
        ("other/coast/sensor/radar-1/report", ""),
        ("", ""),
    ],
)
def test_the_sensor_of_a_key(key: str, sensor: str) -> None:
    assert sensor_of(key) == sensor


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"plots": np.array([3])}, "3 plots of tracks, 2 places sent among 2 plots"),
        ({"which": np.array([0, 2])}, "2 plots of tracks, 2 places sent among 2 plots"),
    ],
)
def test_plots_that_are_not_there_are_refused(changes: dict[str, Any], fault: str) -> None:
    message = picked(1, 2)._replace(plots=np.array([2]), which=np.array([0, 1]), z=np.zeros((2, 2)))
    with pytest.raises(DecodeError, match=fault):
        decode(KEYS.report("radar-1"), encode(message._replace(**changes)))
