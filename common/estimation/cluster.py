"""Clusters of an unknown number of targets: likelihood ratio and cardinality (theory.md §9, Eq. 16).

Targets that may have caused each other's plots must be explained together: a joint history says of every target which
plot of which scan was its own, and no plot is that of two. Given a joint history the targets are independent, so its
likelihood is the product of those of single-target histories, and these are shared by many joint histories::

    LR_n(k) = sum over joint histories h of prod_{i=1..n} lambda(h_i)                                        (16a)

with lambda as in Eq. (15). The targets are drawn from one prior and have no names: of the up to n! joint histories that
differ only in who is who one is kept, with the weight of all.

Plots that two targets cause together (a sensor that cannot resolve them) are not modelled.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from waldnet.common.estimation.association import in_view, innovations, log_weights
from waldnet.common.estimation.batch import take
from waldnet.common.estimation.detection import Notch
from waldnet.common.estimation.extraction import SensorScan, expected_of, in_order, weighed
from waldnet.common.estimation.gating import IntArray
from waldnet.common.estimation.gaussian import Array, Gaussian, log_sum_exp, squared_norm, times_transposed
from waldnet.common.estimation.motion import Motion, predict
from waldnet.common.estimation.notch import hypotheses
from waldnet.common.estimation.sprt import DELETED, StatusArray, Thresholds, decide


class Joint(NamedTuple):
    """Hypotheses that there are exactly n targets: joint histories.

    Attributes:
        log_lambda: logarithms of their likelihood ratios, shape (J,).
        members: numbers of the targets' sub-tracks, ascending, shape (J, n).
    """

    log_lambda: Array
    members: IntArray


class Cluster(NamedTuple):
    """A cluster of one to N targets, all of them sub-tracks of the same few plots.

    Attributes:
        density: sub-tracks, which the joint histories share, shapes (S, n), (S, n, n).
        joint: hypotheses of one target, of two, ..., of N.
        status: of the test, shape (1,).
        log_lr: log LR since the start or the last confirmation (Eq. 16), shape (1,).
        scans: scans used so far.
    """

    density: Gaussian
    joint: tuple[Joint, ...]
    status: StatusArray
    log_lr: Array
    scans: int

    @property
    def log_lr_n(self) -> Array:
        """Logarithms of LR_n (Eq. 16a), shape (N,); after a confirmation scaled so that their mean was 1 there."""
        return np.array([log_sum_exp(joint.log_lambda) for joint in self.joint])

    @property
    def cardinality(self) -> Array:
        """Probabilities c(n) of one target, of two, ..., if there is any (Eq. 16), shape (N,); else all the same."""
        log_lr_n = self.log_lr_n
        if not (log_lr_n > -np.inf).any():
            return np.full(len(log_lr_n), 1.0 / len(log_lr_n))
        probabilities: Array = np.exp(log_lr_n - log_sum_exp(log_lr_n))
        return probabilities

    @property
    def targets(self) -> Gaussian:
        """The most probable number of targets in their heaviest joint history, shapes (n, ...): tracks to start."""
        log_lambda, members = self.joint[int(self.cardinality.argmax())]
        return take(self.density, members[log_lambda.argmax()])


class _Branches(NamedTuple):
    """Every sub-track with every plot, the missed detection first.

    Attributes:
        log_lambda: log p*_j, shape (S, 1 + M); -inf is outside the gate.
        density: after it, shapes (S, 1 + M, n), (S, 1 + M, n, n).
    """

    log_lambda: Array
    density: Gaussian


def cluster(density: Gaussian, most: int, log_w: Array | None = None) -> Cluster:
    """A cluster that starts, with LR_n = 1 for all n.

    Args:
        density: where each target may be, drawn on its own from this mixture, shapes (C, n), (C, n, n).
        most: N, the greatest number of targets thought of.
        log_w: logarithms of the mixture's weights, sum one, shape (C,). None: all the same.

    Returns:
        the cluster before its first scan.
    """
    count = len(density.x)
    if log_w is None:
        log_w = np.full(count, -np.log(count))
    joint = []
    for n in range(1, most + 1):
        members = np.array(list(combinations_with_replacement(range(count), n)), np.intp)
        # Of so many ordered draws each is one without order: n! over the factorials of the multiplicities.
        times = (members[:, :, None] == np.arange(count)).sum(axis=1)
        orders = gammaln(n + 1.0) - gammaln(times + 1.0).sum(axis=-1)
        joint.append(Joint(orders + log_w[members].sum(axis=-1), members))
    return Cluster(density, tuple(joint), np.zeros(1, np.uint8), np.zeros(1), 0)


@dataclass(frozen=True)
class ClusterTest:
    """How clusters are tested.

    Attributes:
        motion: motion model.
        limits: Wald's thresholds.
        hypotheses: most joint histories that are kept for each number of targets.
        prune: joint histories lighter than this share of the heaviest are dropped. Their weight goes to those that are
            kept: LR_n stays what it was, or many targets would look less probable for having more histories.
        gate_probability: that a target's plot is inside the gate of its sub-track; 1 is no gate.
    """

    motion: Motion
    limits: Thresholds
    hypotheses: int = 200
    prune: float = 1e-4
    gate_probability: float = 0.999

    def predict(self, given: Cluster, interval: float) -> Cluster:
        """The cluster after an interval [s]."""
        dt = np.array(interval)
        return given._replace(density=predict(given.density, self.motion.transition(dt), self.motion.noise(dt)))

    def step(self, predicted: Cluster, scan: SensorScan) -> Cluster:
        """Work in a scan and decide (Eq. 14, 16, 16a).

        Args:
            predicted: to the time of the scan.
            scan: of one sensor, z of shape (M, m); no plots is evidence too.

        Returns:
            the cluster after the scan. Where it is confirmed, log LR = 0 and all LR_n are scaled alike.

        References:
            theory.md Eq. (14), (16), (16a); W. Koch, Tracking and sensor data fusion (2014), §4.
        """
        branches = _branched(predicted.density, scan, self.gate_probability)
        grown = [self._kept(_grown(joint, branches.log_lambda)) for joint in predicted.joint]
        # Sub-tracks that no joint history speaks of any more are forgotten, the others numbered anew.
        used = np.unique(np.concatenate([joint.members.ravel() for joint in grown]))
        joint = tuple(joint._replace(members=np.searchsorted(used, joint.members)) for joint in grown)
        which = np.divmod(used, branches.log_lambda.shape[1])
        density = Gaussian(*(part[which] for part in branches.density))
        after = predicted._replace(density=density, joint=joint, scans=predicted.scans + 1)
        log_lr = log_sum_exp(after.log_lr_n) - np.log(len(joint))
        verdict = decide(log_lr[None], predicted.status, self.limits)
        if verdict.accepted[0]:
            joint = tuple(part._replace(log_lambda=part.log_lambda - log_lr) for part in joint)
        return after._replace(joint=joint, log_lr=verdict.log_lr, status=verdict.status)

    def _kept(self, joint: Joint) -> Joint:
        """The heaviest joint histories, with the weight of all."""
        log_lambda = joint.log_lambda
        order = np.argsort(-log_lambda, kind="stable")[: self.hypotheses]
        limit = np.log(self.prune) if self.prune > 0.0 else -np.inf
        # Where the scan is impossible (p_d = 1, and fewer plots than targets) all weights are zero, and all are kept.
        order = order[log_lambda[order] >= log_lambda[order[0]] + limit]
        kept = take(joint, order)
        if len(order) == len(log_lambda) or log_lambda[order[0]] == -np.inf:
            return kept
        return kept._replace(log_lambda=kept.log_lambda + log_sum_exp(log_lambda) - log_sum_exp(kept.log_lambda))


def extract_cluster(
    test: ClusterTest, start: Cluster, start_time: float, scans: Iterable[SensorScan]
) -> Iterator[Cluster]:
    """Test a cluster on scan after scan, until it is deleted.

    Args:
        test: how.
        start: the cluster.
        start_time: its time [s]; scans after it are used.
        scans: by time, of one sensor or several.

    Yields:
        the cluster after each scan.

    Raises:
        ValueError: when a scan is older than the one before.
    """
    given = start
    for interval, scan in in_order(start_time, scans):
        given = test.step(test.predict(given, interval), scan)
        yield given
        if given.status[0] == DELETED:
            return


def _branched(density: Gaussian, scan: SensorScan, gate_probability: float) -> _Branches:
    """Every sub-track with every plot."""
    expected = expected_of(Gaussian(density.x[None], density.P[None]), scan, gate_probability)
    plots = in_view(expected, weighed(scan))
    if isinstance(scan.sensor.detection, Notch):
        log_p_star, (x, P) = hypotheses(expected, plots, scan.sensor.detection, scan.stand)
        return _Branches(log_p_star[0], Gaussian(x[0], P[0]))
    nu = innovations(plots.z, expected.z[0, :, None], expected.angular)
    w = times_transposed(nu, expected.whitener[0])
    distance = squared_norm(w)
    inside = distance <= expected.gate
    if plots.valid is not None:
        inside &= plots.valid
    log_pdf = expected.log_peak[0, :, None] - 0.5 * distance
    (x, P), P_hit = density, expected.P_hit[0]
    hit = x[:, None] + np.matvec(expected.W[0, :, None], w)
    return _Branches(
        log_weights(expected, log_pdf, inside, plots),
        Gaussian(
            np.concatenate((x[:, None], hit), axis=1),
            np.concatenate((P[:, None], np.repeat(P_hit[:, None], hit.shape[1], axis=1)), axis=1),
        ),
    )


def _grown(joint: Joint, log_lambda: Array) -> Joint:
    """All continuations of joint histories in which no plot is that of two targets (Eq. 16a).

    Args:
        joint: before the scan.
        log_lambda: of every sub-track with every plot, shape (S, 1 + M).

    Returns:
        joint histories after the scan; sub-track s with plot j has the number ``s (1 + M) + j``.
    """
    options = log_lambda.shape[1]
    row, weight = np.arange(len(joint.log_lambda)), joint.log_lambda
    choice = np.empty((len(row), 0), np.intp)
    for target in range(joint.members.shape[1]):
        total = weight[:, None] + log_lambda[joint.members[row, target]]
        for taken in choice.T:
            hit = np.flatnonzero(taken)
            total[hit, taken[hit]] = -np.inf
        partial, plot = np.nonzero(total > -np.inf)
        row, weight = row[partial], total[partial, plot]
        choice = np.concatenate((choice[partial], plot[:, None]), axis=1)
    if not len(row):
        return Joint(np.full(len(joint.log_lambda), -np.inf), joint.members * options)
    children = np.sort(joint.members[row] * options + choice, axis=1)
    members, same = np.unique(children, axis=0, return_inverse=True)
    summed = np.full(len(members), -np.inf)
    np.logaddexp.at(summed, same.ravel(), weight)
    return Joint(summed, members)
