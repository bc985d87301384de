"""Studying modes: what a network decides in different modes of fusion, over a few seeds.

A study of thousands of runs, with what each mode sends, is ``waldnet study``.
"""

from importlib.resources import files
from tomllib import loads

import numpy as np

import waldnet

tables = loads(files("waldnet.scenarios").joinpath("four-radars-0.2.toml").read_text(encoding="utf-8"))
modes = {
    "federated": {"mode": "federated"},
    "federated, several hypotheses": {"mode": "federated", "association": "mirrored", "terms": 3},
    "naive": {"mode": "naive"},
    "selected plots": {"mode": "selected"},
}
seeds = range(1, 6)

print(f"{'mode':30} confirmed  falsely  after s  RMSE m")
for name, fusion in modes.items():
    scenario = waldnet.load_scenario({**tables, "fusion": fusion})
    summaries = [
        waldnet.evaluate(
            waldnet.replay(scenario, waldnet.simulate(scenario, seed)),
            waldnet.simulate_truth(scenario, seed),
            cutoff=300.0,
        )
        for seed in seeds
    ]
    found = [summary for summary in summaries if summary["confirmed_targets"]]
    confirmed, false = len(found), sum(summary["false_tracks"] for summary in summaries)
    after = np.mean([summary["confirmed_after_s"] for summary in found])
    rmse = np.mean([summary["rmse_m"] for summary in found])
    print(f"{name:30} {confirmed:4} of {len(seeds)}  {false:7}  {after:7.1f}  {rmse:6.1f}")
