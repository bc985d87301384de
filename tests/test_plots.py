from __future__ import annotations

import gzip
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import all_same, scenario, sensor_table
from hypothesis import given, settings
from hypothesis import strategies as st

from waldnet.common.config import Scenario
from waldnet.common.errors import PlotsError
from waldnet.common.limits import MAX_VALUE
from waldnet.common.messages import Scan
from waldnet.scenarios import catalogue
from waldnet.scenarios.plots import in_order, read_plots, write_plots
from waldnet.scenarios.world import simulate_all

PLOT = scenario()
LINE: dict[str, Any] = {"sensor": "a", "time": 2.0, "plots": [[1.0, 2.0]]}


def read(tmp_path: Path, *lines: Any, plot: Scenario = PLOT) -> list[Scan]:
    path = tmp_path / "plots.jsonl"
    text = "".join((line if isinstance(line, str) else json.dumps(line)) + "\n" for line in lines)
    path.write_text(text, encoding="utf-8")
    return read_plots(path, plot)


def refusal(tmp_path: Path, *lines: Any) -> str:
    """Why a file is refused, without the file's folder."""
    with pytest.raises(PlotsError) as caught:
        read(tmp_path, *lines)
    return str(caught.value).removeprefix(f"{tmp_path}/")


def written(scans: list[Scan], plot: Scenario = PLOT) -> str:
    file = io.StringIO()
    write_plots(file, scans, plot)
    return file.getvalue()


def test_a_line_is_a_scan(tmp_path: Path) -> None:
    (scan,) = read(tmp_path, {**LINE, "plots": [[1.5, -2.0], [3, 4]]})
    assert (scan.sensor, scan.time_ns) == ("a", PLOT.epoch_ns + 2_000_000_000)
    assert scan.z.tolist() == [[1.5, -2.0], [3.0, 4.0]]
    assert scan.z.dtype == np.float64
    assert scan.position.tolist() == [3000.0, 0.0]


def test_an_empty_scan_is_kept(tmp_path: Path) -> None:
    (scan,) = read(tmp_path, {**LINE, "plots": []})
    assert scan.z.shape == (0, 2)


def test_a_sensor_that_moves_says_where_it_is(tmp_path: Path) -> None:
    here, there, standing = read(
        tmp_path,
        {**LINE, "time": 1.0, "position": [5.0, 6.0]},
        {**LINE, "time": 2.0, "position": [7, 8]},
        {**LINE, "time": 3.0},
    )
    assert here.position.tolist() == [5.0, 6.0]
    assert there.position.tolist() == [7.0, 8.0]
    assert standing.position.tolist() == [3000.0, 0.0]


def test_scans_come_by_time_and_then_by_sensor(tmp_path: Path) -> None:
    lines = [{"sensor": name, "time": time, "plots": []} for time in (3, 1, 2.0, -1.5) for name in ("b", "a")]
    scans = read(tmp_path, *lines)
    assert [(PLOT.to_seconds(scan.time_ns), scan.sensor) for scan in scans] == [
        (time, name) for time in (-1.5, 1.0, 2.0, 3.0) for name in ("a", "b")
    ]
    assert all_same(in_order(reversed(scans), PLOT), scans)


def test_sensors_of_a_recording_can_be_ignored(tmp_path: Path) -> None:
    """Only those that are named, and what they say need not fit the scenario."""
    plot = scenario(recording={"plots": "plots.jsonl", "ignore": ["camera"]})
    camera = {"sensor": "camera", "time": 1.0, "plots": [[0.5]]}
    assert [scan.sensor for scan in read(tmp_path, camera, LINE, {**camera, "time": 2.0}, plot=plot)] == ["a"]
    with pytest.raises(PlotsError, match="2: sensor: 'lidar' is not one of a, b"):
        read(tmp_path, LINE, {**camera, "sensor": "lidar"}, plot=plot)
    with pytest.raises(PlotsError, match="has no scan"):
        read(tmp_path, camera, plot=plot)


def test_empty_lines_do_not_count(tmp_path: Path) -> None:
    assert len(read(tmp_path, "", LINE, "  \t", {**LINE, "sensor": "b"}, "")) == 2
    with pytest.raises(PlotsError, match="has no scan"):
        read(tmp_path, "", "")


def test_three_dimensions(tmp_path: Path) -> None:
    plot = scenario(
        sensor_table(position=[1.0, 2.0, 3.0], sigma=[1.0, 1.0, 1.0], field_of_view={"shape": "disc", "radius": 5.0}),
        motion={"psd": 1.0, "dimensions": 3},
        hypothesis=[],
        target=[],
    )
    (scan,) = read(tmp_path, {**LINE, "plots": [[1, 2, 3], [4, 5, 6]]}, plot=plot)
    assert scan.z.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert scan.position.tolist() == [1.0, 2.0, 3.0]


def test_a_simulated_world_comes_back_from_its_file(tmp_path: Path) -> None:
    scans = simulate_all(PLOT, 3)
    assert all_same(read(tmp_path, written(scans)), scans)


number = st.floats(-MAX_VALUE, MAX_VALUE)


@settings(deadline=None, derandomize=True, database=None)
@given(
    st.integers(-(10**15), 10**15),
    st.tuples(number, number),
    st.lists(st.tuples(number, number), max_size=4),
)
def test_any_scan_comes_back_from_its_line(
    tmp_path_factory: pytest.TempPathFactory, offset_ns: int, position: Any, plots: Any
) -> None:
    scan = Scan("b", PLOT.epoch_ns + offset_ns, np.array(position), np.array(plots, np.float64).reshape(-1, 2))
    assert all_same(read(tmp_path_factory.mktemp("plots"), written([scan])), [scan])


def test_a_line_reads_like_the_documentation_says() -> None:
    scan = Scan("a", PLOT.to_ns(2.5), np.array([3000.0, 0.0]), np.array([[1.0, 2.5]]))
    assert written([scan]) == '{"sensor": "a", "time": 2.5, "position": [3000.0, 0.0], "plots": [[1.0, 2.5]]}\n'


BAD = [
    ("{", "is no JSON: Expecting property name enclosed in double quotes at column 2"),
    ("[1, 2]", "is a JSON list, expected an object with sensor, time and plots"),
    ("null", "is a JSON NoneType, expected an object with sensor, time and plots"),
    ({"sensor": "a", "time": 2.0}, "plots is missing"),
    ({"sensor": "a", "plots": []}, "time is missing"),
    ({"time": 2.0, "plots": []}, "sensor is missing"),
    ({**LINE, "plot": []}, "'plot' is no known key; expected heading, plots, position, sensor, time, velocity"),
    ({**LINE, "sensor": "c"}, "sensor: 'c' is not one of a, b"),
    ({**LINE, "sensor": 1}, "sensor: 1 is not one of a, b"),
    ({**LINE, "sensor": ["a"]}, "sensor: ['a'] is not one of a, b"),
    ({**LINE, "time": "2"}, "time: '2' is not a number of seconds between -4e+09 and 4e+09"),
    ({**LINE, "time": True}, "time: True is not a number of seconds between -4e+09 and 4e+09"),
    ({**LINE, "time": None}, "time: None is not a number of seconds between -4e+09 and 4e+09"),
    ('{"sensor": "a", "time": NaN, "plots": []}', "time: nan is not a number of seconds between -4e+09 and 4e+09"),
    (
        '{"sensor": "a", "time": -Infinity, "plots": []}',
        "time: -inf is not a number of seconds between -4e+09 and 4e+09",
    ),
    (
        {**LINE, "time": 1767225600000},
        "time: 1767225600000 is not a number of seconds between -4e+09 and 4e+09; "
        "are these milliseconds, or nanoseconds?",
    ),
    ({**LINE, "plots": 3}, "plots: 3 is not a list of plots"),
    ({**LINE, "plots": {"0": [1, 2]}}, "plots: {'0': [1, 2]} is not a list of plots"),
    ({**LINE, "plots": [1, 2]}, "plots.0: 1 is not a list of 2 finite numbers"),
    ({**LINE, "plots": [[1, 2], [1, 2, 3]]}, "plots.1: [1, 2, 3] is not a list of 2 finite numbers"),
    ({**LINE, "plots": [[1, "2"]]}, "plots.0: [1, '2'] is not a list of 2 finite numbers"),
    ({**LINE, "plots": [[1, False]]}, "plots.0: [1, False] is not a list of 2 finite numbers"),
    ({**LINE, "plots": [[1, float("nan")]]}, "plots.0: [1, nan] is not a list of 2 finite numbers"),
    ({**LINE, "plots": [[1, float("inf")]]}, "plots.0: [1, inf] is not a list of 2 finite numbers"),
    (
        {**LINE, "plots": [[1, 2], [2147483647.0, 1]]},
        "plots.1: east 2147483647 is no coordinate in metres (-1e+09 to 1e+09)",
    ),
    ({**LINE, "plots": [[1, -3e38]]}, "plots.0: north -3e+38 is no coordinate in metres (-1e+09 to 1e+09)"),
    ({**LINE, "position": [1.0, 2e9]}, "position: 2000000000.0 is not between -1e+09 and 1e+09"),
    ({**LINE, "plots": [[1, 2]] * 65536}, "plots: has 65536 plots, expected at most 65535"),
    ({**LINE, "position": [1.0]}, "position: [1.0] is not a list of 2 finite numbers"),
    ({**LINE, "position": 3}, "position: 3 is not a list of 2 finite numbers"),
]


@pytest.mark.parametrize(("line", "reason"), BAD, ids=[reason for _, reason in BAD])
def test_a_bad_line_is_named(tmp_path: Path, line: Any, reason: str) -> None:
    assert refusal(tmp_path, {**LINE, "time": 1.0}, "", line) == f"plots.jsonl:3: {reason}"


@pytest.mark.parametrize(
    "line",
    [
        '{"sensor": "a", "time": 1' + "0" * 400 + ', "plots": []}',
        '{"sensor": "a", "time": 1e300, "plots": []}',
        '{"sensor": "a", "time": 1e12, "plots": []}',
        '{"sensor": "a", "time": 1, "plots": [[18446744073709551616' + "0" * 400 + ", 1]]}",
        "[" * 100_000,
    ],
    ids=["digits of a time", "time beyond floats", "time beyond 64 bits", "digits of a plot", "deep nesting"],
)
def test_numbers_and_nesting_beyond_all_bounds(tmp_path: Path, line: str) -> None:
    assert refusal(tmp_path, line).startswith("plots.jsonl:1: ")


def test_a_plot_may_be_a_large_whole_number(tmp_path: Path) -> None:
    (scan,) = read(tmp_path, '{"sensor": "a", "time": 1, "plots": [[1000000000, 1]]}')
    assert scan.z.tolist() == [[1e9, 1.0]]


def test_a_scan_that_is_there_twice(tmp_path: Path) -> None:
    lines = [LINE, {**LINE, "sensor": "b"}, {**LINE, "plots": []}]
    assert refusal(tmp_path, *lines) == "plots.jsonl:3: a has a scan at 2.0 s already, line 1"


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(PlotsError) as caught:
        read_plots(tmp_path / "none", PLOT)
    assert str(caught.value) == f"{tmp_path / 'none'}: cannot be read: No such file or directory"


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "plots.jsonl"
    path.write_bytes(b'{"sensor": "\xe9"}')
    with pytest.raises(PlotsError) as caught:
        read_plots(path, PLOT)
    assert str(caught.value) == f"{path}: is no UTF-8 text: invalid continuation byte at byte 12"


def test_all_faults_are_listed_up_to_a_bound(tmp_path: Path) -> None:
    lines = [LINE, {**LINE, "sensor": "c"}, "{", {**LINE, "time": 3.0}, LINE]
    listed = refusal(tmp_path, *lines).replace(f"{tmp_path}/", "").splitlines()
    assert [fault.split(": ")[0] for fault in listed] == ["plots.jsonl:2", "plots.jsonl:3", "plots.jsonl:5"]
    assert listed[-1] == "plots.jsonl:5: a has a scan at 2.0 s already, line 1"
    many = refusal(tmp_path, *["{"] * 50).splitlines()
    assert len(many) == 21
    assert many[-1].endswith("plots.jsonl: 30 more lines are wrong, 50 in all")


PACKED = {
    "as it is": lambda content: content,
    "byte order mark": lambda content: b"\xef\xbb\xbf" + content,
    "gzip": gzip.compress,
    "gzip of a byte order mark": lambda content: gzip.compress(b"\xef\xbb\xbf" + content),
    "two gzip members": lambda content: gzip.compress(content[:9]) + gzip.compress(content[9:]),
}


@pytest.mark.parametrize("pack", PACKED.values(), ids=PACKED)
@pytest.mark.parametrize("name", ["plots.jsonl", "plots.jsonl.gz"])
def test_a_byte_order_mark_and_gzip_are_read(tmp_path: Path, name: str, pack: Callable[[bytes], bytes]) -> None:
    (tmp_path / name).write_bytes(pack(written(simulate_all(PLOT, 3)).encode()))
    assert all_same(read_plots(tmp_path / name, PLOT), simulate_all(PLOT, 3))


@pytest.mark.parametrize("harm", [lambda b: b[:-12], lambda b: b[:12] + b"\0" * 9 + b[21:]], ids=["short", "broken"])
def test_a_damaged_gzip_file_is_named(tmp_path: Path, harm: Callable[[bytes], bytes]) -> None:
    path = tmp_path / "plots.jsonl.gz"
    path.write_bytes(harm(gzip.compress(written(simulate_all(PLOT, 3)).encode())))
    with pytest.raises(PlotsError, match=r"plots.jsonl.gz: is damaged, gzip cannot decompress it: "):
        read_plots(path, PLOT)


RECORDED = [
    ("scenario2.jsonl", {"radar": (70, 437), "lidar": (234, 412)}, (1.18751, 118.7)),
    ("scenario5.jsonl", {"radar": (83, 443), "lidar": (276, 375)}, (0.217359, 138.9)),
]


@pytest.mark.parametrize(("name", "content", "times"), RECORDED, ids=["2", "5"])
def test_the_recorded_ferry(name: str, content: dict[str, tuple[int, int]], times: tuple[float, float]) -> None:
    fov = {"shape": "disc", "radius": 500.0}
    sensors = [sensor_table(sensor, position=None, field_of_view=fov, sigma=[5.0, 5.0]) for sensor in content]
    path = catalogue.FOLDER / "autoferry" / name
    recording = {"plots": path, "ignore": ["daylight", "infrared"]}
    plot = scenario(*sensors, epoch="2021-05-04T07:54:51Z", recording=recording)
    scans = read_plots(path, plot)
    seen = {sensor: [scan for scan in scans if scan.sensor == sensor] for sensor in content}
    assert {sensor: (len(own), sum(len(scan.z) for scan in own)) for sensor, own in seen.items()} == content
    assert all(np.diff([scan.time_ns for scan in own]).min() > 0 for own in seen.values())
    assert plot.to_seconds(scans[0].time_ns) == times[0]
    assert plot.to_seconds(scans[-1].time_ns) == pytest.approx(times[1], abs=0.1)
    assert len({tuple(scan.position) for scan in scans}) > 100
