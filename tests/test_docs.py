"""The commands of README and how-to's run as they stand there."""

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from process_helpers import Processes

from waldnet.common.health import fault
from waldnet.scenarios.truth import read_truth

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
HOW_TO = (ROOT / "docs/how-to/first-network.md").read_text()
STUDY = (ROOT / "docs/how-to/study.md").read_text()
SENSORS = (ROOT / "docs/how-to/sensors.md").read_text()
EVALUATE = (ROOT / "docs/how-to/evaluate.md").read_text()
MEASURE = (ROOT / "docs/how-to/measure.md").read_text()
DEPLOY = (ROOT / "docs/how-to/deploy.md").read_text()
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
MORE_PAGES = [ROOT / "CHANGELOG.md", *sorted((ROOT / "scenarios").glob("*/README.md"))]
LONGEST_LINE = 120
#: Pages whose lines are still longer, to be shortened.
LONG_LINES = {
    "CHANGELOG.md",
    "scenarios/autoferry/README.md",
    "scenarios/joyride/README.md",
    "scenarios/solent/README.md",
}
WALDNET = str(Path(sys.executable).with_name("waldnet"))


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def commands(text: str) -> Iterator[list[str]]:
    """The ``waldnet`` lines of all shell blocks, as words."""
    for block in blocks(text, "sh"):
        for line in block.splitlines():
            if line.startswith("waldnet "):
                yield [WALDNET, *shlex.split(line, comments=True)[1:]]


def section(text: str, title: str) -> str:
    return next(part for part in re.split(r"^## ", text, flags=re.MULTILINE) if part.startswith(title))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    harbour = blocks(HOW_TO, "toml")[0]
    (tmp_path / "harbour.toml").write_text(harbour)
    (tmp_path / "my-network.toml").write_text(harbour)
    return tmp_path


def run(words: list[str], folder: Path) -> str:
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, f"{shlex.join(words)}: {done.stderr}"
    return done.stdout


@pytest.mark.processes
def test_first_steps_of_the_readme(folder: Path) -> None:
    steps = list(commands(section(README, "First steps")))
    assert len(steps) == 6
    for words in steps:
        run(words, folder)
    assert len((folder / "plots.jsonl").read_text().splitlines()) == 120


@pytest.mark.processes
def test_how_to_on_one_machine(folder: Path) -> None:
    steps = [words for title in ("1.", "2.", "3.") for words in commands(section(HOW_TO, title))]
    assert len(steps) == 5
    *_, lines, lagged = [run(words, folder) for words in steps]
    last = {line["track"]: line["status"] for line in map(json.loads, lines.splitlines())}
    then = [line["time_lag"] for line in map(json.loads, lagged.splitlines()) if line["track"] == 0]
    assert then[:8] == 8 * [None]
    assert then[8] == 0.5
    assert last == {0: "confirmed", 1: "deleted"}
    decisions = json.loads((folder / "harbour-run/decisions.json").read_text())
    assert {track["track"]: track["status"] for track in decisions["tracks"]} == last


def test_the_recorded_plots_of_the_how_to_are_valid(folder: Path) -> None:
    (folder / "plots.jsonl").write_text(blocks(HOW_TO, "json")[1])
    assert "2 scans, 2 plots" in run([WALDNET, "check", "harbour.toml", "plots.jsonl"], folder)


def test_how_to_of_sensors(tmp_path: Path) -> None:
    (tmp_path / "hill.toml").write_text(blocks(SENSORS, "toml")[0])
    (tmp_path / "shown.jsonl").write_text(blocks(SENSORS, "json")[0])
    check, simulate, replay = commands(SENSORS)
    assert "4 sensors" in run(check, tmp_path)
    assert "2 scans, 3 plots" in run([*check, "shown.jsonl"], tmp_path)
    run(simulate, tmp_path)
    assert "track 0: confirmed" in run(replay, tmp_path)


@pytest.mark.processes
@pytest.mark.parametrize("way", ["direct", "router"])
def test_how_to_on_several_machines(folder: Path, way: str) -> None:
    """All on loopback, on a free port, and in lockstep; otherwise as written."""
    every = list(commands(section(HOW_TO, "4.")))
    client = [words for words in every if "client" in words]
    router = [words for words in every if words[1] == "router"]
    direct = [words for words in every if words not in client and words not in router]
    assert (len(direct), len(client), len(router)) == (3, 2, 1)
    client.append([*(word if word != "radar" else "lidar" for word in client[-1])])
    servers, others = (direct[:1], direct[1:]) if way == "direct" else (router, client)
    with ExitStack() as stack:
        port = "0"
        started = []
        for words in [*servers, *others]:
            local = [
                word.replace("0.0.0.0:7447", "127.0.0.1:0").replace("192.168.1.7:7447", f"127.0.0.1:{port}")
                for word in words
            ]
            pace = ["--speed", "max"] if words[1] == "center" else []
            process = subprocess.Popen(
                [*local, *pace], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
            stack.enter_context(process)
            stack.callback(process.terminate)
            started.append((words[1], process))
            if words in servers:
                assert process.stdout is not None
                port = json.loads(process.stdout.readline())["listening"][0].rsplit(":", 1)[1]
        for kind, process in started:
            if kind != "router":
                assert process.wait(60) == 0, kind


@pytest.mark.processes
def test_how_to_deploy_without_docker(tmp_path: Path) -> None:
    """As written, but on loopback, with all sensors, and in lockstep; the watcher first, to the end."""
    router, center, node, watch = commands(section(DEPLOY, "Without Docker"))
    nodes = [[word.replace("radar-1", f"radar-{number}") for word in node] for number in range(1, 5)]
    with Processes(tmp_path) as processes:
        local = [word.replace("0.0.0.0:7447", "127.0.0.1:0") for word in router]
        (at,) = json.loads(processes.start(*local).await_line("listening"))["listening"]
        others = [[*watch, "--until-end"], [*center, "--speed", "max"], *nodes]
        started = [processes.start(*(word.replace("tcp/192.168.1.7:7447", at) for word in words)) for words in others]
        assert [process.wait() for process in started] == 6 * [0]
        assert "2026-01-01 00:00:02.00Z     2.00 s  track 0 confirmed after 1 scans, log LR +33.33" in started[0].out


def test_the_health_shown_is_that_of_a_node() -> None:
    shown = json.loads(blocks(section(DEPLOY, "Health"), "json")[0])
    assert fault(shown, 30.0) is None


@pytest.mark.processes
def test_how_to_study(tmp_path: Path) -> None:
    steps = [words for title in ("1.", "4.") for words in commands(section(STUDY, title))]
    assert len(steps) == 3
    said = [run(words, tmp_path) for words in steps]
    assert "study/report.html" in said[0]
    assert "track 0: confirmed" in said[2]
    columns = (tmp_path / "study/summary.csv").read_text().splitlines()[0].split(",")
    shown = re.findall(r"`(\w+)`", section(STUDY, "3.").partition("What the columns mean")[2])
    assert len(shown) > 10
    unknown = {name for name in shown if name.rstrip("_") == name and not name.startswith("_")} - set(columns)
    assert unknown == {"lost_beyond"}


@pytest.mark.processes
def test_how_to_evaluate_a_recording(tmp_path: Path) -> None:
    (tmp_path / "scenarios").symlink_to(ROOT / "scenarios")
    (tmp_path / "shown.jsonl").write_text(blocks(EVALUATE, "json")[0])
    steps = list(commands(section(EVALUATE, "A recorded")))
    assert len(steps) == 2
    *_, said = [run(words, tmp_path) for words in steps]
    shown = [line.rstrip() for line in blocks(EVALUATE, "text")[0].splitlines()]
    assert [line.rstrip() for line in said.splitlines()][: len(shown)] == shown
    assert read_truth(tmp_path / "shown.jsonl")[1].times_s.tolist() == [0.16]


def test_how_to_evaluate_beside_the_centralised_run(tmp_path: Path) -> None:
    (tmp_path / "scenarios").symlink_to(ROOT / "scenarios")
    alone, (*replay, _, lines), evaluate = commands(section(EVALUATE, "The centralised"))
    assert "track 0: confirmed" in run(alone, tmp_path)
    (tmp_path / lines).write_text(run(replay, tmp_path))
    assert "lines (centralised)" in run(evaluate, tmp_path)


@pytest.mark.processes
def test_how_to_evaluate_simulations(tmp_path: Path) -> None:
    steps = list(commands(section(EVALUATE, "Simulated")))
    assert len(steps) == 4
    for words in steps:
        run(words, tmp_path)
    assert (tmp_path / "four-radars/comparison.png").exists()


def test_how_to_measure() -> None:
    said = [run(words, ROOT) for words in commands(MEASURE)]
    assert blocks(MEASURE, "text")[0] in said[0]
    assert "Targets are the confirmed tracks" in said[1]


def test_schema_is_the_one_the_program_prints() -> None:
    assert (ROOT / "scenarios/scenario.schema.json").read_text() == run([WALDNET, "schema"], ROOT)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), target


def prose(page: str) -> list[str]:
    """Lines that can be broken: those outside tables, code, output of commands, comments, and of more than a link."""
    blank = re.sub(r"^```.*?^```|<!-- figures:.*?<!-- end -->|<!--.*?-->", "", page, flags=re.DOTALL | re.MULTILINE)
    return [
        line
        for line in blank.splitlines()
        if not line.startswith(("|", "    ")) and not re.fullmatch(r"[-*\d. ]*!?(\[.*?\]\(\S+\)|<?https?:\S+)", line)
    ]


def test_prose_is_what_can_be_broken() -> None:
    page = """word
| cell |
```sh
fenced
```
<!-- a
comment -->
<!-- figures: a command -->
printed
<!-- end -->
    indented
- [a link](docs/x.md)
https://example.org
a sentence with [a link](docs/x.md)
"""
    assert [line for line in prose(page) if line] == ["word", "a sentence with [a link](docs/x.md)"]


@pytest.mark.parametrize("page", [*PAGES, *MORE_PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_lines_are_short(page: Path) -> None:
    long = [line for line in prose(page.read_text()) if len(line) > LONGEST_LINE]
    assert not long or str(page.relative_to(ROOT)) in LONG_LINES, long


def test_code_places_of_the_theory_exist() -> None:
    places = re.findall(r"`([\w/]+\.py)(?:: (\w+))?", section((ROOT / "docs/theory.md").read_text(), "14."))
    assert len(places) > 30
    for path, name in places:
        assert (ROOT / path).is_file(), path
        assert name in (ROOT / path).read_text(), f"{path}: {name}"
