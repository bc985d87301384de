"""Evaluating a recording: a ferry with radar and lidar, and where the boats truly were.

The recording is scenario 2 of Autoferry (NTNU, CC0); beside the network stands one tracker that gets all plots.
"""

import waldnet

scenario = waldnet.load_scenario("autoferry-2")
assert scenario.recording is not None
recording = scenario.recording.plots
scans = waldnet.read_plots(recording, scenario)
truth = recording.with_name("scenario2-truth.jsonl")
print(f"{recording.name}: {len(scans)} scans, {sum(len(scan.plots) for scan in scans)} plots")

rows = ("confirmed_targets", "targets", "held_share", "rmse_m", "breaks", "swaps", "false_tracks")
network, centralised = (
    waldnet.evaluate(waldnet.replay(scenario, scans, centralised=one), truth, cutoff=25.0) for one in (False, True)
)
print(f"{'':20} {'network':>10} {'centralised':>12}")
for row in rows:
    print(f"{row:20} {network[row]:10.2f} {centralised[row]:12.2f}")
print(f"{'GOSPA [m]':20} {network['gospa_m']['total']:10.2f} {centralised['gospa_m']['total']:12.2f}")
