"""A formation: is there a target at all, how many are there, and where were they?

Track extraction tests one possible target as a sum of sub-tracks. A cluster of an unknown number of targets has a
likelihood ratio for each number. Retrodiction tells where a track was, with everything known now.
"""

import numpy as np

from waldnet import estimation as est

rng = np.random.default_rng(4)
motion = est.ConstantVelocity(dimensions=2, psd=0.5)
sensor = est.Sensor(
    est.Position(sigma=(5.0, 5.0), n=motion.n), p_d=0.9, false_plots=2.0, field_of_view=est.Box((400.0, 400.0))
)
limits = est.thresholds(p0=1e-3, p1=0.95)

# Three targets side by side, 40 m apart, at 15 m/s; eight scans, one a second.
targets = np.array([[-60.0, -40.0, 15.0, 0.0], [-60.0, 0.0, 15.0, 0.0], [-60.0, 40.0, 15.0, 0.0]])
scans = []
for time in range(1, 9):
    places = targets[:, :2] + time * targets[:, 2:]
    seen = (places + rng.normal(0.0, 5.0, (3, 2)))[rng.random(3) < sensor.p_d]
    plots = np.concatenate([seen, rng.uniform(-200.0, 200.0, (rng.poisson(sensor.false_plots), 2))])
    scans.append(est.SensorScan(float(time), sensor, [0.0, 0.0], [0.0, 0.0], plots))

# Somewhere here, at about that speed: what is known before the first scan.
prior = est.Gaussian([-60.0, 0.0, 15.0, 0.0], np.diag([100.0, 1600.0, 9.0, 9.0]))

extractor = est.Extractor(motion, limits, est.Reduction())
start = est.candidates(np.array([0]), est.Gaussian(prior.x[None, None], prior.P[None, None]))
for scan, found in zip(scans, est.extract(extractor, start, 0.0, scans), strict=False):
    status = est.Status(found.status[0]).name.lower()
    sub_tracks = int((found.log_w[0] > -np.inf).sum())
    print(f"{scan.time:.0f} s: a target? log LR {found.log_lr[0]:+5.1f}, {status}; {sub_tracks} sub-tracks")

test = est.ClusterTest(motion, limits)
for scan, cluster in zip(
    scans,
    est.extract_cluster(test, est.cluster(est.Gaussian(prior.x[None], prior.P[None]), 4), 0.0, scans),
    strict=False,
):
    chances = ", ".join(f"{n}: {chance:.2f}" for n, chance in enumerate(cluster.cardinality, 1))
    print(f"{scan.time:.0f} s: how many? {chances}")
for x in cluster.targets.x:
    print(f"a target at east {x[0]:.0f} m, north {x[1]:.0f} m")

# The middle target filtered on its own, and smoothed.
track, filtered = est.Gaussian(prior.x, np.diag([100.0, 100.0, 9.0, 9.0])), []
for scan in scans:
    track = est.predict(track, motion.transition(1.0), motion.noise(1.0))
    clutter = est.Clutter(sensor.p_d, sensor.log_rho_f, p_g=0.999)
    track, _ = est.pdaf(track, scan.plots, sensor.measurement.linearise(track, scan.stand), clutter)
    filtered.append(track)
every = est.Gaussian(np.array([each.x for each in filtered]), np.array([each.P for each in filtered]))
smoothed = est.smooth(every, motion, np.ones(len(scans) - 1))
truth = targets[1, :2] + np.arange(1, 9)[:, None] * targets[1, 2:]
for name, path in (("filtered", every), ("smoothed", smoothed)):
    print(f"{name}: RMSE {np.sqrt(np.square(path.x[:, :2] - truth).sum(axis=-1).mean()):.1f} m")
