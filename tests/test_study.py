"""A study from command to tables: the same whoever computes it, and going on where it was stopped."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import study_fakes
from builders import scenario, sensor_table
from process_helpers import WALDNET, Process, Processes

from waldnet.common.errors import ConfigError, StudyError, TransportError, WaldnetError
from waldnet.studies import workers
from waldnet.studies.cli import study as command
from waldnet.studies.parts import Store
from waldnet.studies.plan import Order, to_toml
from waldnet.studies.report import SHEETS
from waldnet.studies.study import Study, join
from waldnet.studies.tables import csv_of
from waldnet.studies.workers import Part, play_jobs

PLOT = scenario(simulation={"duration": 8.0})
ORDER = Order(modes=("naive", "dkf"), runs=7, seed=3, p_d=(0.9, 0.4), no_target=True, block=3)
TABLES = ("summary", "curves", "decisions", "calibration", "runs")


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    study_fakes.take_over(monkeypatch)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(to_toml(PLOT))
    return path


def done(folder: Path, order: Order = ORDER, **options: Any) -> tuple[Study, list[Part]]:
    """A study that was played to its end, and the parts that it took."""
    study, parts = Study(PLOT, order, folder, **options), []
    study.play(1, None, parts.append)
    return study, parts


def tables_of(study: Study) -> dict[str, str]:
    return {name: csv_of(table) for name, table in study.judge()._asdict().items()}


def test_all_is_played_once(fakes: None, tmp_path: Path) -> None:
    study, parts = done(tmp_path / "s")
    assert study.plays == study.plays_to_do == 3 * 2 * 7
    assert sum(len(part.job.seeds) for part in parts) == study.plays
    again, nothing = done(tmp_path / "s")
    assert (again.plays_to_do, nothing) == (0, [])
    assert tables_of(again) == tables_of(study)


def test_a_run_is_the_world_of_its_seed(fakes: None, tmp_path: Path) -> None:
    study, _ = done(tmp_path / "s")
    runs = study.judge().runs
    first = runs["world_seed"][(runs["variant"] == "p_d=0.4") & (runs["mode"] == "dkf")]
    assert first.tolist() == [3_000_000 + i for i in range(7)]


def test_a_study_goes_on_where_it_was_stopped(fakes: None, tmp_path: Path) -> None:
    class StoppedError(Exception):
        pass

    def stop_after_five(_: Part) -> None:
        kept.append(1)
        if len(kept) == 5:
            raise StoppedError

    kept: list[int] = []
    with pytest.raises(StoppedError):
        Study(PLOT, ORDER, tmp_path / "s").play(1, None, stop_after_five)
    study, parts = done(tmp_path / "s")
    assert len(parts) == 3 * 2 * 3 - 5
    assert tables_of(study) == tables_of(done(tmp_path / "other")[0])


def test_more_modes_and_more_runs_keep_what_is_there(fakes: None, tmp_path: Path) -> None:
    done(tmp_path / "s")
    _, modes = done(tmp_path / "s", ORDER._replace(modes=("naive", "federated", "dkf")))
    assert {part.mode for part in modes} == {"federated"}
    study, runs = done(tmp_path / "s", ORDER._replace(runs=11))
    # Seven runs were two blocks of three and one run; eleven are three blocks and two runs.
    assert sorted({(part.job.first, len(part.job.seeds)) for part in runs}) == [(6, 3), (9, 2)]
    few, many = done(tmp_path / "other")[0].judge().runs, study.judge().runs
    for name, column in few.items():
        prefix = many[name][many["run"] < 7]
        if column.dtype == np.float64:
            np.testing.assert_allclose(prefix, column, rtol=1e-12)
        else:
            assert (prefix == column).all(), name


@pytest.mark.parametrize(
    ("plot", "order", "said"),
    [
        (PLOT, ORDER._replace(seed=4), "another seed (3, now 4)"),
        (PLOT, ORDER._replace(block=4), "another runs per block (3, now 4)"),
        (scenario(simulation={"duration": 6.0}), ORDER, "another scenario (test "),
    ],
)
def test_parts_of_another_study_are_not_mixed_in(
    fakes: None, tmp_path: Path, plot: Any, order: Order, said: str
) -> None:
    done(tmp_path / "s")
    with pytest.raises(ConfigError) as error:
        Study(plot, order, tmp_path / "s")
    assert said in str(error.value)
    assert "--fresh to discard them" in str(error.value)
    assert Study(plot, order, tmp_path / "s", fresh=True).plays_to_do == 3 * 2 * 7


def test_another_program_is_another_study(fakes: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done(tmp_path / "s")
    monkeypatch.setattr("waldnet.studies.study.program_digest", lambda: "other")
    with pytest.raises(ConfigError, match="another version of waldnet or of NumPy"):
        Study(PLOT, ORDER, tmp_path / "s")


def test_a_worker_of_another_version_is_refused(fakes: None, tmp_path: Path) -> None:
    study = Study(PLOT, ORDER, tmp_path / "s")
    with pytest.raises(StudyError, match="another version of waldnet"):
        next(play_jobs([study.to_do[0]._replace(program="older")], 1, None))


@pytest.mark.parametrize("damage", ["cut", "garbled", "foreign", "empty"])
def test_a_damaged_part_is_played_again(fakes: None, tmp_path: Path, damage: str) -> None:
    study, _ = done(tmp_path / "s")
    expected = tables_of(study)
    one, other = sorted((tmp_path / "s/parts").rglob("*.npz"))[:2]
    content = one.read_bytes()
    middle = len(content) // 2
    one.write_bytes(
        {
            "cut": content[:middle],
            "garbled": content[:middle]
            + bytes(byte ^ 255 for byte in content[middle : middle + 200])
            + content[middle + 200 :],
            "foreign": other.read_bytes(),
            "empty": b"",
        }[damage]
    )
    again, parts = done(tmp_path / "s")
    assert len(parts) == 1
    assert tables_of(again) == expected


def test_a_part_that_vanished_is_told(fakes: None, tmp_path: Path) -> None:
    study, _ = done(tmp_path / "s")
    next((tmp_path / "s/parts").rglob("*.npz")).unlink()
    with pytest.raises(StudyError, match="run the command again"):
        study.judge()


def test_what_is_written_is_whole_or_not_at_all(fakes: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = Study(PLOT, ORDER, tmp_path / "s")
    part = next(play_jobs(study.to_do[:1], 1, None))

    def full(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        study.store.save(part.job, part.mode, part.result)
    assert not [path for path in (tmp_path / "s/parts").rglob("*") if path.is_file()]
    assert not study.store.has(part.job, part.mode)


def test_bytes_of_blocks_are_weighted_by_their_runs(fakes: None, tmp_path: Path) -> None:
    study = Study(PLOT, ORDER, tmp_path / "s")
    results = [next(play_jobs([job], 1, None)).result for job in study.to_do[:3]]
    assert [len(result.log_lr) for result in results] == [3, 3, 1]
    joined = join([result._replace(uplink_bytes=float(up)) for result, up in zip(results, (7, 7, 0), strict=True)])
    assert joined.uplink_bytes == pytest.approx(6.0)


def test_the_folder_is_told_when_it_is_none(tmp_path: Path) -> None:
    (tmp_path / "s").write_text("something else")
    with pytest.raises(ConfigError, match="is a file; --out takes a folder"):
        Store(tmp_path / "s", {})
    (tmp_path / "t").mkdir()
    (tmp_path / "t/study.json").write_text("[1, 2")
    with pytest.raises(ConfigError, match="is not what a study writes"):
        Store(tmp_path / "t", {})


def test_the_command_writes_tables_report_and_scenarios(
    fakes: None, file: Path, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr("waldnet.studies.report.SHEETS", SHEETS[:1])
    command(str(file), modes="naive, dkf,naive", runs=5, seed=2, p_d="0.9,0.3", no_target=True, out=out, block=4)
    said = capsys.readouterr()
    assert [line for line in said.err.splitlines() if "done" in line] == [
        "p_d=0.9: done",
        "p_d=0.3: done",
        "no-target: done",
    ]
    for name in TABLES:
        assert (out / f"{name}.csv").exists()
        assert (out / f"{name}.parquet").exists()
        assert f"{name}.csv" in said.out
    rows = (out / "summary.csv").read_text().splitlines()
    asked = (
        "variant mode runs log_lr_mean p_confirmed p_deleted decision_scans_mean share_lost rmse_m bytes_per_track_scan"
    )
    assert set(asked.split()) <= set(rows[0].split(","))
    keys = [tuple(row.split(",")[:3]) for row in rows[1:]]
    assert keys == [(v, m, "5") for v in ("p_d=0.9", "p_d=0.3", "no-target") for m in ("naive", "dkf")]
    assert sorted(path.name for path in (out / "variants").iterdir()) == [
        "no-target.toml",
        "p_d=0.3.toml",
        "p_d=0.9.toml",
    ]
    assert (out / "report.html").read_text().count("<svg") == 1
    command(str(file), modes="naive,dkf", runs=5, seed=2, p_d="0.9,0.3", no_target=True, out=out, block=4)
    assert "30 of 30 runs x modes are there already" in capsys.readouterr().err


def test_the_seed_is_the_scenarios_unless_given(
    fakes: None, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("waldnet.studies.report.SHEETS", ())
    command(str(file), modes="naive", runs=1, out=tmp_path / "out")
    assert json.loads((tmp_path / "out/study.json").read_text())["seed"] == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"modes": "federated-tigth"}, "did you mean 'federated-tight'?"),
        ({"runs": 0}, "--runs: 0 is not between"),
        ({"p_d": "0.9,much"}, "--p-d: 'much' is not a number"),
        ({"p_d": "1.5"}, "--p-d: 1.5 is not a probability"),
        ({"workers": 0}, "--workers: 0 is not positive"),
    ],
)
def test_a_wrong_command_is_told_what_is_wrong(
    fakes: None, file: Path, tmp_path: Path, options: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError) as error:
        command(str(file), out=tmp_path / "out", **options)
    assert said in str(error.value)
    assert not (tmp_path / "out").exists()


def test_a_cluster_needs_its_library_and_a_scheduler(
    fakes: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = Study(PLOT, ORDER, tmp_path / "s")
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"pip install 'waldnet\[study\]'"):
        study.play(1, "tcp://127.0.0.1:1", lambda _: None)


@pytest.fixture
def real() -> Iterator[Order]:
    """Small, and of modes that there are."""
    return Order(modes=("centralised", "federated"), runs=5, seed=1, p_d=(0.9,), no_target=True, block=2)


@pytest.mark.processes
def test_the_tables_are_the_same_whatever_the_number_of_workers(tmp_path: Path, real: Order) -> None:
    tables = []
    for count in (1, 2):
        study = Study(PLOT, real, tmp_path / str(count))
        study.play(count, None, lambda _: None)
        study.write(study.judge())
        tables.append(
            [(tmp_path / str(count) / f"{name}.{kind}").read_bytes() for name in TABLES for kind in ("csv", "parquet")]
        )
    assert tables[0] == tables[1]


@pytest.mark.processes
@pytest.mark.filterwarnings("ignore")  # the cluster's own
def test_the_tables_are_the_same_on_a_cluster(tmp_path: Path, real: Order) -> None:
    from distributed import LocalCluster

    here = Study(PLOT, real, tmp_path / "here")
    here.play(1, None, lambda _: None)
    there = Study(PLOT, real, tmp_path / "there")
    with LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, protocol="tcp", dashboard_address=None
    ) as cluster:
        there.play(1, cluster.scheduler_address, lambda _: None)
    assert tables_of(here) == tables_of(there)


@pytest.mark.processes
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_goes_is_told_and_what_is_finished_stays(tmp_path: Path, real: Order) -> None:
    from distributed import LocalCluster

    study = Study(PLOT, real._replace(runs=60, block=1), tmp_path / "s")
    kept: list[Part] = []
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
    ) as cluster:

        def close_after_one(part: Part) -> None:
            kept.append(part)
            if len(kept) == 1:
                cluster.close()

        with pytest.raises(StudyError, match="gave up"):
            study.play(1, cluster.scheduler_address, close_after_one)
    assert 0 < len(kept) < 240
    assert sum(study.store.has(part.job, part.mode) for part in kept) == len(kept)


@pytest.mark.processes
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_does_not_answer_is_told(fakes: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_PATIENCE_S", 1)
    study = Study(PLOT, ORDER, tmp_path / "s")
    for address in ("tcp://127.0.0.1:1", "nowhere"):
        with pytest.raises(TransportError, match="no dask scheduler at"):
            study.play(1, address, lambda _: None)


def await_part(processes: Processes, study: Process, parts: Path) -> None:
    """Return once a study has finished a part; the test's time limit is the patience."""
    while not list(parts.glob("*.npz")):
        assert study.pid in processes.alive(), study.err
        time.sleep(0.05)  # the study needs the processor


@pytest.mark.processes
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("count", [1, 2])
def test_stopped_it_says_how_to_go_on_and_leaves_nobody_behind(
    processes: Processes, tmp_path: Path, number: signal.Signals, code: int, count: int
) -> None:
    """Long enough that nobody waits for its end; the first variant is small enough to be done soon."""
    path = tmp_path / "long.toml"
    path.write_text(to_toml(scenario(sensor_table("a"), sensor_table("b"), simulation={"duration": 200.0})))
    options = ("--modes", "federated", "--runs", "2000", "--block", "1", "--out", "out", "--workers", count)
    process = processes.waldnet("study", path, *options)
    parts = tmp_path / "out/parts/as-given/federated"
    await_part(processes, process, parts)
    family = processes.alive()
    process.signal(number)
    assert process.wait() == code
    assert process.err == ["stopped; what is finished is in out. The same command goes on"]
    processes.await_end(family)
    assert not list(parts.glob("*.tmp"))
    assert len(list(parts.glob("*.npz"))) < 2000


@pytest.mark.processes
def test_it_can_be_stopped_where_whoever_started_it_ignores_the_signal(processes: Processes, tmp_path: Path) -> None:
    """A shell ignores SIGINT for what it runs in the background, and its children inherit that."""
    path = tmp_path / "long.toml"
    path.write_text(to_toml(scenario(simulation={"duration": 200.0})))
    options = ("--modes", "federated", "--runs", "2000", "--block", "1", "--out", "out", "--workers", "2")
    process = processes.start("sh", "-c", 'trap "" INT; exec "$@"', "sh", WALDNET, "study", str(path), *options)
    await_part(processes, process, tmp_path / "out/parts/as-given/federated")
    family = processes.alive()
    process.signal(signal.SIGINT)
    assert process.wait() == 130
    processes.await_end(family)


@pytest.mark.processes
def test_workers_end_when_their_study_is_killed(processes: Processes, tmp_path: Path) -> None:
    path = tmp_path / "long.toml"
    path.write_text(to_toml(scenario(simulation={"duration": 200.0})))
    options = ("--modes", "federated", "--runs", "2000", "--block", "1", "--out", "out", "--workers", 2)
    process = processes.waldnet("study", path, *options)
    parts = tmp_path / "out/parts/as-given/federated"
    await_part(processes, process, parts)
    family = processes.alive()
    assert len(family) >= 3
    process.signal(signal.SIGKILL)
    processes.await_end(family)


@pytest.mark.processes
def test_errors_of_the_command_line_are_one_clear_message(processes: Processes, tmp_path: Path) -> None:
    process = processes.waldnet("study", "four-radars", "--modes", "centralized", "--out", "out")
    assert process.wait() == 1
    assert process.err[0] == "--modes: 'centralized' is no mode; did you mean 'centralised'?"
    assert len(process.err) == 2
    assert issubclass(StudyError, WaldnetError)
