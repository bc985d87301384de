"""Replay: simulate a network, let it decide, and look at its tracks.

Four radars, each with few detections (p_d = 0.2), watch one target and four places where nothing is.
"""

import waldnet

scenario = waldnet.load_scenario("four-radars-0.2")
scans = waldnet.simulate(scenario, seed=1)
print(f"{scenario.name}: {len(scans)} scans of {', '.join(scenario.sensor_names)}")

pictures = []
for picture in waldnet.replay(scenario, scans):
    pictures.append(picture)
    for decision in picture.decisions:
        print(
            f"{picture.time:6.1f} s  track {decision.track} {decision.kind} after {decision.scans} scans, "
            f"log LR {decision.log_lr:+.1f}"
        )

for track in pictures[-1].tracks:
    east, north = track.x[:2]
    print(f"track {track.id}: {track.status}, at east {east:.0f} m, north {north:.0f} m")

# One row for every track at every time: pandas.DataFrame(columns), polars.DataFrame(columns), pyarrow.table(columns).
columns = waldnet.columns(pictures)
confirmed = columns["status"] == "confirmed"
print(f"{confirmed.sum()} rows of confirmed tracks; mean sd_east {columns['sd_east'][confirmed].mean():.1f} m")

# The same plots as one file or another source would give them; a generator without end would do as well.
own = [waldnet.Scan(scan.sensor, time=scan.time, plots=scan.plots.tolist()) for scan in scans]
last = list(waldnet.replay(scenario, own))[-1]
print("the same from lists:", [track.status for track in last.tracks] == [track.status for track in picture.tracks])
