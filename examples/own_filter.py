"""Your own filter loop: a target among false plots, filtered by PDAF and tested by Wald's test, scan by scan."""

import numpy as np

from waldnet import estimation as est

rng = np.random.default_rng(1)
motion = est.ConstantVelocity(dimensions=2, psd=1.0)
# A sensor that measures positions: sigma 10 m, p_d 0.8, on average 10 false plots in a square of 1 km.
sensor = est.Sensor(
    est.Position(sigma=(10.0, 10.0), n=motion.n), p_d=0.8, false_plots=10.0, field_of_view=est.Box((1000.0, 1000.0))
)
clutter = est.Clutter(sensor.p_d, sensor.log_rho_f, p_g=0.999)
limits = est.thresholds(p0=1e-4, p1=0.95)
stand = np.zeros(2)

truth = np.array([-200.0, 100.0, 20.0, -5.0])
F, Q = motion.transition(1.0), motion.noise(1.0)

# Two hypotheses: track 0 is where the target is, track 1 where nothing is.
tracks = est.Gaussian(
    x=[[-180.0, 90.0, 15.0, 0.0], [300.0, 300.0, 0.0, 0.0]], P=2 * [np.diag([400.0, 400.0, 100.0, 100.0])]
)
log_lr, status = np.zeros(2), np.zeros(2, np.uint8)

for scan in range(1, 13):
    truth = F @ truth + rng.multivariate_normal(np.zeros(4), Q)
    plots = [rng.uniform(-500.0, 500.0, 2) for _ in range(rng.poisson(sensor.false_plots))]
    if rng.random() < sensor.p_d:
        plots.append(truth[:2] + rng.normal(0.0, 10.0, 2))

    tracks = est.predict(tracks, F, Q)
    tracks, log_p_bar = est.pdaf(tracks, est.Plots(plots), sensor.measurement.linearise(tracks, stand), clutter)

    # The logarithm of the weight sum is the step of log LR; the test starts anew after a confirmation.
    log_lr, status, *_ = est.decide(log_lr + log_p_bar, status, limits)
    error = np.linalg.norm(tracks.x[0, :2] - truth[:2])
    names = [est.Status(value).name.lower() for value in status]
    print(
        f"scan {scan:2}: {len(plots):2} plots, log LR {log_lr[0]:+5.1f} {names[0]:10} error {error:4.1f} m; "
        f"log LR {log_lr[1]:+5.1f} {names[1]}"
    )
