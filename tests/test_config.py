from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from builders import scenario, sensor_table
from hypothesis import given, settings
from hypothesis import strategies as st

from waldnet.common.config import Network, Scenario, load_network, load_scenario
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.association import Choice, kalman, nearest, normalise
from waldnet.common.estimation.field_of_view import Box, Disc, Everywhere
from waldnet.common.estimation.mixture import Reduction
from waldnet.common.initiation_config import InitiationConfig
from waldnet.scenarios import catalogue

GOOD = """\
name = "coast"
origin = { latitude = 50.6, longitude = 7.2 }
epoch = 2026-01-01T00:00:00Z

[network]
name = "coast-net"
mode = "client"
connect = ["tcp/192.168.1.7:7447"]

[motion]
model = "cv"
dimensions = 2
psd = 10.0

[decision]
p0 = 1e-3
p1 = 0.9
enabled = true

[initiation]
plots = 2
speed = 15.0
max_speed = 40.0
within = 4.0
claimed = 0.4
gate = 0.95
merge = 0.0
tentative = 200

[fusion]
mode = "federated"
association = "tight"
feedback = "advice"
filter = "pdaf"
gate_probability = 1.0
hold_back = 0.25
window = 5.0
joint = false

[[sensor]]
name = "radar-1"
kind = "position"
position = [13000.0, 0.0]
sigma = [50.0, 40.0]
p_d = 0.5
false_plots = 5.0
field_of_view = { shape = "box", center = [0.0, 0.0], size = [4000.0, 3000.0] }
scan_interval = 2.0
first_scan = 0.5

[[sensor]]
name = "radar-2"
sigma = [30.0, 30.0]
p_d = 1.0
false_plots = 1e-6
field_of_view = { shape = "disc", radius = 1000.0 }

[[sensor]]
name = "radar-3"
sigma = [30.0, 30.0]
p_d = 0.0
false_plots = 2.0
field_of_view = { shape = "everywhere", area = 1e6 }

[simulation]
duration = 60.0
seed = 4

[study]
lost_beyond = 250.0

[recording]
plots = "plots.jsonl"

[[target]]
start = -4.0
state = [0.0, 0.0, 150.0, 0.0]

[[target]]
hypothesis = 0

[[hypothesis]]
start = 2.0
state = [0.0, 0.0, 150.0, 0.0]
sigma = [100.0, 90.0, 20.0, 10.0]
"""


def load(tmp_path: Path, text: str | bytes) -> Scenario:
    path = tmp_path / "scenario.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_scenario(path)


def faults(tmp_path: Path, text: str | bytes) -> list[str]:
    """The faults of a file, without its path."""
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text)
    lines = str(caught.value).split("\n")
    prefix = f"{tmp_path / 'scenario.toml'}: "
    assert all(line.startswith(prefix) for line in lines)
    return [line.removeprefix(prefix) for line in lines]


def edited(old: str, new: str) -> str:
    """The good file with one place changed."""
    assert GOOD.count(old) >= 1
    return GOOD.replace(old, new, 1)


def test_a_good_file_is_read(tmp_path: Path) -> None:
    loaded = load(tmp_path, GOOD)
    assert loaded.name == "coast"
    assert loaded.origin is not None
    assert (loaded.origin.latitude, loaded.origin.longitude) == (50.6, 7.2)
    assert loaded.epoch == datetime(2026, 1, 1, tzinfo=UTC)
    assert loaded.network == Network(name="coast-net", mode="client", connect=("tcp/192.168.1.7:7447",))
    assert (loaded.motion.dimensions, loaded.motion.psd) == (2, 10.0)
    assert (loaded.decision.p0, loaded.decision.p1, loaded.decision.enabled) == (1e-3, 0.9, True)
    assert (loaded.fusion.feedback, loaded.fusion.hold_back, loaded.fusion.window) == ("advice", 0.25, 5.0)
    assert not loaded.fusion.joint
    assert loaded.initiation == InitiationConfig(
        plots=2, speed=15.0, max_speed=40.0, within=4.0, claimed=0.4, gate=0.95, merge=0.0, tentative=200
    )
    assert loaded.sensor_names == ("radar-1", "radar-2", "radar-3")
    assert loaded.sensors[0].first_scan == 0.5
    assert loaded.simulation is not None
    assert (loaded.simulation.duration, loaded.simulation.seed) == (60.0, 4)
    assert loaded.study.lost_beyond == 250.0
    assert loaded.targets[0].state == (0.0, 0.0, 150.0, 0.0)
    assert (loaded.targets[1].hypothesis, loaded.targets[1].state) == (0, None)
    assert np.array_equal(loaded.hypotheses[0].density.P, np.diag([100.0**2, 90.0**2, 20.0**2, 10.0**2]))


def test_what_is_left_out_has_a_default(tmp_path: Path) -> None:
    text = """
name = "least"
motion = { psd = 0 }
[[sensor]]
name = "a"
sigma = [1, 1]
p_d = 1
false_plots = 1
field_of_view = { shape = "disc", radius = 1 }
"""
    loaded = load(tmp_path, text)
    assert loaded.motion.dimensions == 2
    assert (loaded.decision.p0, loaded.decision.p1, loaded.decision.enabled) == (1e-4, 0.95, True)
    fusion = loaded.fusion
    assert (fusion.mode, fusion.association, fusion.feedback, fusion.filter) == ("federated", "tight", "none", None)
    assert (fusion.terms, fusion.feedback_delay, fusion.joint, loaded.joint) == (1, 0.0, None, False)
    assert fusion.mixture.build() == Reduction(15, 1e-4, 0.5)
    assert (loaded.network.name, loaded.network.mode, loaded.network.multicast) == ("least", "peer", False)
    assert (loaded.sensors[0].scan_interval, loaded.sensors[0].first_scan) == (1.0, None)
    assert (loaded.simulation, loaded.recording, loaded.targets, loaded.hypotheses) == (None, None, (), ())
    assert loaded.initiation is None


def test_how_tracks_start_has_defaults(tmp_path: Path) -> None:
    first, last = GOOD.index("[initiation]"), GOOD.index("[fusion]")
    starts = load(tmp_path, f"{GOOD[:first]}[initiation]\nspeed = 20\n{GOOD[last:]}").initiation
    assert starts is not None
    assert (starts.plots, starts.within, starts.claimed, starts.gate) == (1, 5.0, 0.5, 0.99)
    assert (starts.merge, starts.tentative, starts.fastest) == (0.5, 1000, 60.0)
    assert starts.spread(6, 2).tolist() == [20.0, 20.0, 1.0, 1.0]


def test_the_recording_is_beside_the_scenario(tmp_path: Path) -> None:
    recording = load(tmp_path, GOOD).recording
    assert recording is not None
    assert recording.plots == tmp_path / "plots.jsonl"
    absolute = load(tmp_path, edited('"plots.jsonl"', '"/data/plots.jsonl"')).recording
    assert absolute is not None
    assert absolute.plots == Path("/data/plots.jsonl")


def test_a_sensor_cannot_be_ignored_and_used(tmp_path: Path) -> None:
    recording = load(tmp_path, edited('"plots.jsonl"', '"plots.jsonl"\nignore = ["camera"]')).recording
    assert recording is not None
    assert recording.ignore == ("camera",)
    both = edited('"plots.jsonl"', '"plots.jsonl"\nignore = ["camera", "radar-2"]')
    assert faults(tmp_path, both) == ["recording.ignore: 'radar-2' is a sensor of this scenario"]


ADVICE_NEEDS = (
    "fusion.feedback: 'advice' steers the association filter of a single Gaussian, "
    "which only association = 'tight' with another filter than 'mht' has"
)
DKF_NEEDS = "fusion.mode: 'dkf' needs covariances that do not depend on data: no mixture, no feedback = 'reset'"
MIRRORED_ADVICE = 'association = "mirrored"\nfeedback = "advice"'
DKF_MHT = 'mode = "dkf"\nfilter = "mht"'
DKF_MIRRORED = 'mode = "dkf"\nassociation = "mirrored"'

FAULTS = [
    # the whole
    ('name = "coast"\n', "", "name: is missing"),
    ('name = "coast"', 'name = "the coast"', "name: got 'the coast': string should match pattern '^[A-Za-z0-9_.-]+$'"),
    ('name = "coast"', 'name = "coast"\ncolour = "red"', "colour: is no known key"),
    ('name = "coast"', 'name = "coast"\nbox = "red"', "box: is no known key"),
    ("latitude = 50.6", "latitude = 91", "origin.latitude: got 91: input should be less than or equal to 90"),
    (
        "longitude = 7.2",
        "longitude = -181",
        "origin.longitude: got -181: input should be greater than or equal to -180",
    ),
    (
        "epoch = 2026-01-01T00:00:00Z",
        "epoch = 2026-01-01T00:00:00",
        "epoch: 2026-01-01T00:00:00 has no time zone; write it like 2026-01-01T00:00:00Z",
    ),
    # network
    ('mode = "client"', 'mode = "sun"', "network.mode: 'sun' is not one of 'peer', 'client' or 'router'"),
    ('connect = ["tcp/192.168.1.7:7447"]', "ports = 7447", "network.ports: is no known key"),
    # motion
    ("psd = 10.0\n", "", "motion.psd: is missing"),
    ("psd = 10.0", "psd = -1", "motion.psd: -1 is not zero or positive and finite"),
    ("psd = 10.0", "psd = nan", "motion.psd: nan is not zero or positive and finite"),
    ('model = "cv"', 'model = "cx"', "motion.model: 'cx' is not one of 'cv', 'ca', 'ct' or 'imm'"),
    ('model = "cv"', 'model = "ct"', "motion.turn_rate: is missing"),
    ("psd = 10.0", "psd = 10.0\nturn_rate = 0.1", "motion.turn_rate: is of model = 'ct', not of 'cv'"),
    ("psd = 10.0", "psd = 10.0\nsojourn = 30.0", "motion.sojourn: is of model = 'imm', not of 'cv'"),
    (
        "psd = 10.0",
        "psd = 10.0\nmodels = [{ psd = 1.0 }, { psd = 2.0 }]",
        "motion.models: is of model = 'imm', not of 'cv'",
    ),
    ("dimensions = 2", "dimensions = 4", "motion.dimensions: 4 is not one of 2 or 3"),
    # decision
    ("p0 = 1e-3", "p0 = 0", "decision.p0: 0 is not a probability strictly between 0 and 1"),
    ("p1 = 0.9", "p1 = 1.0", "decision.p1: 1 is not a probability strictly between 0 and 1"),
    ("p0 = 1e-3", "p0 = 0.9", "decision.p1: 0.9 is not above p0 = 0.9; no threshold lies between"),
    ("p1 = 0.9", "p1 = 1e-4", "decision.p1: 0.0001 is not above p0 = 0.001; no threshold lies between"),
    ("p1 = 0.9", "p1 = 0.9\nkeep = 1e-4", "decision.keep: 0.0001 is not above p0 = 0.001; no threshold lies between"),
    # initiation
    ("plots = 2", "plots = 3", "initiation.plots: 3 is not one of 1 or 2"),
    ("plots = 2", "scans = 2", "initiation.scans: is no known key"),
    ("speed = 15.0\n", "", "initiation.speed: is missing"),
    ("speed = 15.0", "speed = 0", "initiation.speed: 0 is not positive and finite"),
    ("speed = 15.0", "speed = 15.0\nacceleration = -1", "initiation.acceleration: -1 is not positive and finite"),
    ("max_speed = 40.0", "max_speed = inf", "initiation.max_speed: inf is not positive and finite"),
    ("within = 4.0", "within = 0", "initiation.within: 0 is not positive and finite"),
    ("claimed = 0.4", "claimed = 1.5", "initiation.claimed: 1.5 is not a probability (0 to 1)"),
    ("gate = 0.95", "gate = 0", "initiation.gate: 0 is not a probability above 0 (1 is no gate)"),
    ("merge = 0.0", "merge = -0.5", "initiation.merge: -0.5 is not zero or positive and finite"),
    ("tentative = 200", "tentative = -1", "initiation.tentative: got -1: input should be greater than or equal to 0"),
    # fusion
    (
        "joint = false",
        'joint = "never"',
        "fusion.joint: got 'never': input should be a valid boolean, unable to interpret input",
    ),
    (
        'mode = "federated"',
        'mode = "best"',
        "fusion.mode: 'best' is not one of 'naive', 'federated', 'dkf' or 'selected'",
    ),
    (
        'association = "tight"\nfeedback = "advice"',
        'association = "loose"',
        "fusion.association: 'loose' is not one of 'factor', 'tight' or 'mirrored'",
    ),
    (
        'filter = "pdaf"',
        'filter = "imm"',
        "fusion.filter: 'imm' is not one of 'kalman', 'nearest', 'pdaf' or 'mht'",
    ),
    ('feedback = "advice"', 'feedback = "loop"', "fusion.feedback: 'loop' is not one of 'none', 'advice' or 'reset'"),
    ('filter = "pdaf"', 'filter = "mht"', ADVICE_NEEDS),
    ('filter = "pdaf"', "terms = 3", "fusion.terms: 3 terms of a report need association = 'mirrored'"),
    ('filter = "pdaf"', "terms = 0", "fusion.terms: got 0: input should be greater than or equal to 1"),
    (
        'association = "tight"\nfeedback = "advice"\nfilter = "pdaf"',
        'association = "mirrored"\nterms = 65',
        "fusion.terms: got 65: input should be less than or equal to 64",
    ),
    ('filter = "pdaf"', "terms = 1.5", "fusion.terms: got 1.5: input should be a valid integer"),
    (
        'association = "tight"\nfeedback = "advice"',
        'association = "mirrored"',
        "fusion.filter: 'pdaf' keeps one hypothesis; association = 'mirrored' needs 'mht', or no filter key",
    ),
    ('association = "tight"\nfeedback = "advice"\nfilter = "pdaf"', MIRRORED_ADVICE, ADVICE_NEEDS),
    ('mode = "federated"\nassociation = "tight"\nfeedback = "advice"', 'mode = "dkf"\nfeedback = "reset"', DKF_NEEDS),
    ('mode = "federated"\nassociation = "tight"\nfeedback = "advice"\nfilter = "pdaf"', DKF_MHT, DKF_NEEDS),
    ('mode = "federated"\nassociation = "tight"\nfeedback = "advice"\nfilter = "pdaf"', DKF_MIRRORED, DKF_NEEDS),
    (
        "window = 5.0",
        "window = 5.0\nfeedback_delay = 5.5",
        "fusion.feedback_delay: 5.5 s is longer than the 5.0 s (fusion.window) that nodes keep scans",
    ),
    (
        "window = 5.0",
        "feedback_delay = 10.5",
        "fusion.feedback_delay: 10.5 s is longer than the 10.0 s (fusion.window) that nodes keep scans",
    ),
    (
        "window = 5.0",
        "feedback_delay = -1",
        "fusion.feedback_delay: -1 is not zero or positive and finite",
    ),
    (
        'filter = "pdaf"',
        "mixture = { components = 0 }",
        "fusion.mixture.components: got 0: input should be greater than or equal to 1",
    ),
    (
        'filter = "pdaf"',
        "mixture = { prune = 1.0 }",
        "fusion.mixture.prune: got 1.0: input should be less than 1",
    ),
    ('filter = "pdaf"', "mixture = { combine = -1 }", "fusion.mixture.combine: -1 is not zero or positive and finite"),
    ('filter = "pdaf"', "mixture = { rest = true }", "fusion.mixture.rest: is no known key"),
    (
        "gate_probability = 1.0",
        "gate_probability = 0.0",
        "fusion.gate_probability: 0 is not a probability above 0 (1 is no gate)",
    ),
    ("hold_back = 0.25", "hold_back = -0.5", "fusion.hold_back: -0.5 is not zero or positive and finite"),
    ("window = 5.0", "window = inf", "fusion.window: inf is not zero or positive and finite"),
    (
        'association = "tight"',
        'association = "factor"',
        ADVICE_NEEDS,
    ),
    # sensor
    ("p_d = 0.5", "p_d = 1.4", "sensor.0.p_d: 1.4 is not a probability (0 to 1)"),
    ("p_d = 0.5", "p_d = nan", "sensor.0.p_d: nan is not a probability (0 to 1)"),
    ("p_d = 0.5\n", "", "sensor.0.p_d: is missing"),
    (
        "p_d = 0.5",
        'p_d = "often"',
        "sensor.0.p_d: got 'often': input should be a valid number",
    ),
    ("sigma = [50.0, 40.0]", "sigma = [50.0, 0.0]", "sensor.0.sigma.1: 0 is not positive and finite"),
    (
        "sigma = [50.0, 40.0]",
        "sigma = [50.0]",
        "sensor.0.sigma: has 1 numbers, this scenario's dimensions need 2",
    ),
    ("sigma = [50.0, 40.0]", "sigma = 50.0", "sensor.0.sigma: got 50.0: input should be a valid tuple"),
    (
        "position = [13000.0, 0.0]",
        "position = [13000.0, 0.0, 5.0]",
        "sensor.0.position: has 3 numbers, this scenario's dimensions need 2",
    ),
    ("position = [13000.0, 0.0]", "position = [inf, 0.0]", "sensor.0.position.0: inf is not finite"),
    (
        "false_plots = 5.0",
        "false_plots = 0.0",
        "sensor.0.false_plots: 0 is not positive and finite; without false plots one plot would prove a target and "
        "there is nothing to test: give the smallest mean you believe, such as 1e-6",
    ),
    ("scan_interval = 2.0", "scan_interval = 0", "sensor.0.scan_interval: 0 is not positive and finite"),
    ("first_scan = 0.5", "first_scan = -0.5", "sensor.0.first_scan: -0.5 is not zero or positive and finite"),
    (
        'kind = "position"',
        'kind = "nose"',
        "sensor.0.kind: 'nose' is not one of 'position', 'polar', 'polar-doppler' or 'bearing'",
    ),
    ('name = "radar-2"', 'name = "radar-1"', "sensor.1.name: 'radar-1' is taken already"),
    (
        'name = "radar-2"',
        'name = "radar/2"',
        "sensor.1.name: got 'radar/2': string should match pattern '^[A-Za-z0-9_.-]+$'",
    ),
    ('name = "radar-2"\n', "", "sensor.1.name: is missing"),
    # field of view
    (
        'shape = "box"',
        'shape = "star"',
        "sensor.0.field_of_view: shape 'star' is not one of 'everywhere', 'box', 'disc', 'sector'",
    ),
    ('shape = "box", ', "", "sensor.0.field_of_view: shape is missing"),
    (", size = [4000.0, 3000.0]", "", "sensor.0.field_of_view.size: is missing"),
    ("size = [4000.0, 3000.0]", "size = [4000.0, -1]", "sensor.0.field_of_view.size.1: -1 is not positive and finite"),
    (
        "size = [4000.0, 3000.0]",
        "size = [4000.0]",
        "sensor.0.field_of_view.size: has 1 numbers, this scenario's dimensions need 2",
    ),
    (
        "center = [0.0, 0.0]",
        "center = [0.0]",
        "sensor.0.field_of_view.center: has 1 numbers, this scenario's dimensions need 2",
    ),
    ("radius = 1000.0", "radius = 0.0", "sensor.1.field_of_view.radius: 0 is not positive and finite"),
    ("radius = 1000.0", "radius = 1.0, size = [1.0, 1.0]", "sensor.1.field_of_view.size: is no known key"),
    ("radius = 1000.0", "radius = 1.0, box = 3", "sensor.1.field_of_view.box: is no known key"),
    ("area = 1e6", "area = inf", "sensor.2.field_of_view.area: inf is not positive and finite"),
    # world
    ("duration = 60.0\n", "", "simulation.duration: is missing"),
    ("lost_beyond = 250.0", "lost_beyond = 0", "study.lost_beyond: 0 is not positive and finite"),
    ("seed = 4", "seed = -4", "simulation.seed: got -4: input should be greater than or equal to 0"),
    ("state = [0.0, 0.0, 150.0, 0.0]\n\n[[target]]\nh", "\n[[target]]\nh", "target.0: give either state or hypothesis"),
    ("start = -4.0", "hypothesis = 0", "target.0: give either state or hypothesis"),
    (
        "state = [0.0, 0.0, 150.0, 0.0]\n\n",
        "state = [0.0, 0.0, 150.0]\n\n",
        "target.0.state: has 3 numbers, this scenario's dimensions and motion need 4",
    ),
    (
        "hypothesis = 0",
        "hypothesis = 1",
        "target.1.hypothesis: 1 is not one of the 1 hypotheses (counted from 0)",
    ),
    ("hypothesis = 0", "hypothesis = -1", "target.1.hypothesis: got -1: input should be greater than or equal to 0"),
    ("start = 2.0", "start = nan", "hypothesis.0.start: nan is not finite"),
    (
        "sigma = [100.0, 90.0, 20.0, 10.0]",
        "sigma = [100.0, 90.0, 20.0]",
        "hypothesis.0.sigma: has 3 numbers, this scenario's dimensions and motion need 4",
    ),
    (
        "sigma = [100.0, 90.0, 20.0, 10.0]",
        "sigma = [100.0, 90.0, 20.0, 0.0]",
        "hypothesis.0.sigma.3: 0 is not positive and finite",
    ),
    ("sigma = [100.0, 90.0, 20.0, 10.0]\n", "", "hypothesis.0.sigma: is missing"),
]


@pytest.mark.parametrize(("old", "new", "fault"), FAULTS, ids=[fault.split(": ")[0] for _, _, fault in FAULTS])
def test_a_fault_is_named(tmp_path: Path, old: str, new: str, fault: str) -> None:
    assert faults(tmp_path, edited(old, new)) == [fault]


def test_all_faults_are_named_at_once(tmp_path: Path) -> None:
    text = GOOD
    expected = []
    # One edit per key, and none that turns another edit's place into something else.
    for old, new, fault in FAULTS:
        if text.count(old) and fault.split(": ")[0] not in [line.split(": ")[0] for line in expected]:
            changed = text.replace(old, new, 1)
            if set(faults(tmp_path, changed)) == {*expected, fault}:
                text, expected = changed, [*expected, fault]
    assert len(expected) > 30
    assert sorted(faults(tmp_path, text)) == sorted(expected)


def test_three_dimensions_need_longer_lists(tmp_path: Path) -> None:
    assert faults(tmp_path, edited("dimensions = 2", "dimensions = 3")) == [
        "sensor.0.sigma: has 2 numbers, this scenario's dimensions need 3",
        "sensor.0.position: has 2 numbers, this scenario's dimensions need 3",
        "sensor.0.field_of_view.size: has 2 numbers, this scenario's dimensions need 3",
        "sensor.0.field_of_view.center: has 2 numbers, this scenario's dimensions need 3",
        "sensor.1.sigma: has 2 numbers, this scenario's dimensions need 3",
        "sensor.2.sigma: has 2 numbers, this scenario's dimensions need 3",
        "hypothesis.0.state: has 4 numbers, this scenario's dimensions and motion need 6",
        "hypothesis.0.sigma: has 4 numbers, this scenario's dimensions and motion need 6",
        "target.0.state: has 4 numbers, this scenario's dimensions and motion need 6",
    ]


@pytest.mark.parametrize("wrong", ["3", '"x"', "[3]", "[[3]]", "{ a = 1 }", "[{ a = 1 }]", "true"])
@pytest.mark.parametrize(
    "key", ["motion", "decision", "initiation", "fusion", "network", "sensor", "target", "hypothesis"]
)
def test_tables_of_another_kind_are_faults(tmp_path: Path, key: str, wrong: str) -> None:
    first = GOOD.index("[network]")
    assert any(line.startswith(key) for line in faults(tmp_path, f"{GOOD[:first]}{key} = {wrong}\n"))


def test_tracks_start_only_where_a_sensor_tells_a_position(tmp_path: Path) -> None:
    bearing = (
        'kind = "bearing"\nsigma = [0.01]\np_d = 0.9\nfalse_plots = 1\nfield_of_view = { shape = "disc", radius = 1 }'
    )
    polar = bearing.replace("bearing", "polar").replace("[0.01]", "[1.0, 0.01]")
    text = f'name = "x"\nmotion = {{ psd = 1.0 }}\ninitiation = {{ speed = 9.0 }}\n[[sensor]]\nname = "a"\n{bearing}\n'
    fault = "initiation: no sensor tells a position, so that no track can start; all are of kind 'bearing'"
    assert faults(tmp_path, text) == [fault]
    assert load(tmp_path, f'{text}[[sensor]]\nname = "b"\n{polar}\n').initiation is not None


def test_a_scenario_needs_sensors(tmp_path: Path) -> None:
    text = 'name = "x"\nmotion = { psd = 1.0 }\n'
    assert faults(tmp_path, text) == ["sensor: is missing"]
    assert faults(tmp_path, text + "sensor = []\n") == [
        "sensor: got []: tuple should have at least 1 item after validation, not 0"
    ]


@pytest.mark.parametrize("key", ["sensor", "target", "hypothesis"])
def test_tables_have_one_name(tmp_path: Path, key: str) -> None:
    plural = {"sensor": "sensors", "target": "targets", "hypothesis": "hypotheses"}[key]
    found = faults(tmp_path, GOOD.replace(f"[[{key}]]", f"[[{plural}]]"))
    assert f"{plural}: is no known key" in found


@pytest.mark.parametrize("value", ["true", '"0.5"'])
def test_only_a_number_is_a_number(tmp_path: Path, value: str) -> None:
    assert faults(tmp_path, edited("p_d = 0.5", f"p_d = {value}"))[0].startswith("sensor.0.p_d: ")


def test_a_start_beyond_the_range_of_times_is_a_fault(tmp_path: Path) -> None:
    assert faults(tmp_path, edited("start = 2.0", "start = 1e30"))[0].startswith("hypothesis.0.start: ")


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    with pytest.raises(ConfigError) as caught:
        load_scenario(path)
    assert str(caught.value) == f"{path}: cannot be read: No such file or directory"


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load_scenario(tmp_path)
    assert str(caught.value) == f"{tmp_path}: cannot be read: Is a directory"


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    assert faults(tmp_path, b'name = "caf\xe9"') == ["is no UTF-8 text: invalid continuation byte at byte 11"]


def test_a_file_that_is_no_toml(tmp_path: Path) -> None:
    assert faults(tmp_path, 'name = "a"\nname = "b"\n') == [
        "is no TOML: Cannot overwrite a value (at line 2, column 11)"
    ]
    assert faults(tmp_path, "{}") == ["is no TOML: Invalid statement (at line 1, column 1)"]


# Network file ---------------------------------------------------------------------------------------------------------


def network(tmp_path: Path, text: str) -> Network:
    path = tmp_path / "network.toml"
    path.write_text(text, encoding="utf-8")
    return load_network(path)


def test_a_network_file_is_read(tmp_path: Path) -> None:
    text = 'name = "coast"\nmode = "router"\nlisten = ["tcp/0.0.0.0:7447"]\nconnect = ["udp/a:1"]\nmulticast = true\n'
    assert network(tmp_path, text) == Network(
        name="coast", mode="router", listen=("tcp/0.0.0.0:7447",), connect=("udp/a:1",), multicast=True
    )


def test_an_empty_network_file_is_the_default(tmp_path: Path) -> None:
    assert network(tmp_path, "") == Network()


def test_faults_of_a_network_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        network(tmp_path, 'name = "a/b"\nmode = "sun"\nlisten = "tcp/a:1"\nport = 3\n')
    path = tmp_path / "network.toml"
    assert str(caught.value).split("\n") == [
        f"{path}: name: got 'a/b': string should match pattern '^[A-Za-z0-9_.-]+$'",
        f"{path}: mode: 'sun' is not one of 'peer', 'client' or 'router'",
        f"{path}: listen: got 'tcp/a:1': input should be a valid tuple",
        f"{path}: port: is no known key",
    ]


def test_a_network_file_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    with pytest.raises(ConfigError) as caught:
        load_network(path)
    assert str(caught.value) == f"{path}: cannot be read: No such file or directory"


# Catalogue ------------------------------------------------------------------------------------------------------------


def test_scenarios_come_along() -> None:
    assert {"four-radars", "heavy-clutter", "no-target", "thirty-two"} <= set(catalogue.names())


@pytest.mark.parametrize("name", catalogue.names())
def test_every_scenario_that_comes_along_is_good(name: str) -> None:
    loaded = load_scenario(catalogue.find(name))
    assert loaded.name == name
    assert loaded.simulation is not None or (loaded.recording is not None and loaded.recording.plots.is_file())


def test_a_file_goes_before_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert catalogue.find("four-radars") == catalogue.FOLDER / "four-radars.toml"
    (tmp_path / "four-radars").write_text("")
    assert catalogue.find("four-radars") == Path("four-radars")


def test_a_scenario_that_is_nowhere() -> None:
    with pytest.raises(ConfigError) as caught:
        catalogue.find("no-such")
    assert str(caught.value) == (
        f"no-such: no such file, and none of the scenarios that come along: {', '.join(catalogue.names())}"
    )


# Meaning --------------------------------------------------------------------------------------------------------------


def test_the_epoch_counts_in_nanoseconds_whatever_its_zone() -> None:
    assert scenario(epoch="1970-01-01T00:00:00Z").epoch_ns == 0
    assert scenario(epoch="1970-01-02T00:00:00.000001Z").epoch_ns == 86_400_000_001_000
    assert scenario(epoch="2026-01-01T00:00:00Z").epoch_ns == 1_767_225_600_000_000_000
    assert scenario(epoch="2026-01-01T01:00:00+01:00").epoch_ns == 1_767_225_600_000_000_000
    assert scenario(epoch="1969-12-31T23:59:59.5Z").epoch_ns == -500_000_000


def test_seconds_become_nanoseconds() -> None:
    plot = scenario()
    assert plot.to_ns(0.0) == plot.epoch_ns
    assert plot.to_ns(2.5) == plot.epoch_ns + 2_500_000_000
    assert plot.to_ns(0.1) == plot.epoch_ns + 100_000_000
    assert plot.to_ns(-1e-9) == plot.epoch_ns - 1
    assert plot.to_seconds(plot.epoch_ns + 1) == 1e-9


@settings(deadline=None, derandomize=True, database=None)
@given(st.integers(-(10**15), 10**15))
def test_nanoseconds_survive_the_way_over_seconds(offset_ns: int) -> None:
    plot = scenario()
    assert plot.to_ns(plot.to_seconds(plot.epoch_ns + offset_ns)) == plot.epoch_ns + offset_ns


def test_a_sensor_is_found_by_its_name() -> None:
    plot = scenario(sensor_table("a"), sensor_table("b", p_d=0.25))
    assert plot.sensor("b").p_d == 0.25
    with pytest.raises(ConfigError) as caught:
        plot.sensor("c")
    assert str(caught.value) == "test: no sensor 'c'; there are a, b"


@pytest.mark.parametrize(("mode", "multiplicity"), [("naive", 1.0), ("federated", 2.0), ("dkf", 2.0)])
def test_the_share_of_a_sensor(mode: str, multiplicity: float) -> None:
    assert scenario(fusion={"mode": mode}).share.multiplicity == multiplicity


@pytest.mark.parametrize(
    ("fusion", "choice"),
    [
        ({}, normalise),
        ({"filter": "pdaf"}, normalise),
        ({"filter": "nearest"}, nearest),
        ({"filter": "kalman"}, kalman),
        ({"filter": "mht"}, None),
        ({"association": "mirrored"}, None),
        ({"association": "mirrored", "filter": "mht"}, None),
    ],
)
def test_the_filter_of_a_network(fusion: dict[str, str], choice: Choice | None) -> None:
    assert scenario(fusion=fusion).fusion.choice is choice


def test_how_far_a_mixture_may_grow(tmp_path: Path) -> None:
    text = edited(
        'association = "tight"\nfeedback = "advice"\nfilter = "pdaf"',
        'association = "mirrored"\nfeedback = "reset"\nfeedback_delay = 5\nterms = 64\n'
        "mixture = { components = 7, prune = 0.0, combine = 2 }",
    )
    fusion = load(tmp_path, text).fusion
    assert fusion.mixture.build() == Reduction(7, 0.0, 2.0)
    assert (fusion.feedback, fusion.feedback_delay, fusion.terms) == ("reset", 5.0, 64)


def test_fields_of_view() -> None:
    fields = [
        ({"shape": "box", "size": [4.0, 3.0]}, Box((4.0, 3.0))),
        ({"shape": "disc", "radius": 5.0}, Disc(5.0, 2)),
        ({"shape": "everywhere", "area": 6.0}, Everywhere(6.0, 2)),
    ]
    for table, expected in fields:
        plot = scenario(sensor_table(field_of_view=table))
        assert plot.sensors[0].build(plot.motion.build()).field_of_view == expected


def test_a_field_of_view_without_center_moves_with_the_sensor() -> None:
    stand = np.array([7.0, 8.0])
    moving = scenario(sensor_table(field_of_view={"shape": "disc", "radius": 5.0})).sensors[0]
    fixed = scenario(sensor_table(field_of_view={"shape": "disc", "radius": 5.0, "center": [1.0, 2.0]})).sensors[0]
    assert moving.view_center(stand).tolist() == [7.0, 8.0]
    assert fixed.view_center(stand).tolist() == [1.0, 2.0]


def test_where_a_sensor_stands() -> None:
    assert scenario(sensor_table(position=[1.0, 2.0])).sensors[0].stand(2).tolist() == [1.0, 2.0]
    assert scenario(sensor_table(position=None)).sensors[0].stand(2).tolist() == [0.0, 0.0]
    assert scenario(sensor_table(position=[1.0, 2.0])).sensors[0].stand(2, (3.0, 4.0)).tolist() == [3.0, 4.0]


def test_a_scenario_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="frozen"):
        scenario().name = "other"  # type: ignore[misc]


def test_a_byte_order_mark_before_a_scenario(tmp_path: Path) -> None:
    shipped = catalogue.find("no-target")
    (tmp_path / "marked.toml").write_bytes(b"\xef\xbb\xbf" + shipped.read_bytes())
    assert load_scenario(tmp_path / "marked.toml") == load_scenario(shipped)


def test_false_plots_that_no_scan_may_have(tmp_path: Path) -> None:
    text = catalogue.find("no-target").read_text().replace("false_plots = 5.0", "false_plots = 1e9", 1)
    assert faults(tmp_path, text) == [
        "sensor.0.false_plots: 1e+09 is more than the 65535 plots that a scan may have; it is the mean number in one "
        "scan of the whole field of view, not a density"
    ]
