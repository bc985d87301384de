"""What a sensor node keeps between two steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.association import Expected, Plots
from waldnet.common.estimation.batch import concatenate, put, take
from waldnet.common.estimation.clutter_map import ClutterMap
from waldnet.common.estimation.gaussian import Array, BoolArray
from waldnet.common.estimation.mixture import Mixture
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.messages import Advice, Begin, IntArray, Rebase


class Tracks(NamedTuple):
    """What a node keeps of every track, one row a track; a single Gaussian is a mixture of one component.

    Attributes:
        ids: ascending, shape (T,).
        times_ns: of the factors, shape (T,).
        log_w: honest weights of the components, sum one, shape (T, C); -inf is no component.
        log_g: log evidence of the components since the start, with one of them log p_bar, shape (T, C).
        x, P: factors, shapes (T, C, n), (T, C, n, n).
        times_a_ns: of the association filters, shape (T,).
        x_a, P_a: association filters.
        log_odds: of existence, as far as this sensor knows, shape (T,).
        visible: probability to be visible to each sensor of the network, as far as it tells this node, at the time of
            the association filter, shape (T, S).
        network_P: for ``dkf``, the covariances that all sensors' factors have by the models alone, shape
            (T, S, n, n); otherwise S = 0.
    """

    ids: IntArray
    times_ns: IntArray
    log_w: Array
    log_g: Array
    x: Array
    P: Array
    times_a_ns: IntArray
    x_a: Array
    P_a: Array
    log_odds: Array
    visible: Array
    network_P: Array


class Ready(NamedTuple):
    """All of the next scan that its plots do not change.

    Attributes:
        tracks, advice: of the state that it was worked out from; it is of use as long as these are the same.
        time_ns, pose, number: of the scan.
        advised: all tracks, advice followed.
        live: which of them started before the scan.
        predicted: those, at the time of the scan.
        mixture: the same, as the filter has them.
        expected: those, as the sensor will see them.
    """

    tracks: Tracks
    advice: tuple[Advice, ...]
    time_ns: int
    pose: SensorPose
    number: int
    advised: Tracks
    live: BoolArray
    predicted: Tracks
    mixture: Mixture
    expected: Expected

    def fits(self, state: State, time_ns: int, pose: SensorPose, number: int) -> bool:
        """Whether it was worked out from the tracks and advice of a state, for the scan of that time and sensor."""
        same_state = self.tracks is state.tracks and self.advice is state.advice
        same_scan = self.time_ns == time_ns and self.number == number
        return same_state and same_scan and self.pose.equals(pose)


class Beliefs(NamedTuple):
    """What a node knows of tracks beside their densities, one row a track.

    Attributes:
        ids: ascending, shape (T,).
        times_ns, times_a_ns: of the factors and association filters, shape (T,).
        log_odds, visible: as in ``Tracks``.
        log_mu: log probabilities of the motion models in the factor and in the association filter, shape (T, 2, r); of
            a single model none, r = 0.
    """

    ids: IntArray
    times_ns: IntArray
    times_a_ns: IntArray
    log_odds: Array
    visible: Array
    log_mu: Array


class Look(NamedTuple):
    """A scan as the tracker keeps it.

    Attributes:
        time_ns: of the scan.
        pose: of the sensor.
        plots: that all tracks share, with the density of false ones as the map had it then; in a study, where all
            tracks start together, of every track its own.
        number: of the sensor in the scenario.
        log_free: log probability of each plot to belong to none of the tracks there were; None: not told.
        before: what was known of the tracks that have worked it in, just before; None: no feedback will ask for it.
    """

    time_ns: int
    pose: SensorPose
    plots: Plots
    number: int
    log_free: Array | None = None
    before: Beliefs | None = None


class State(NamedTuple):
    """State of a node.

    Attributes:
        epoch: of the newest start message.
        sequence: number of the next report.
        tracks: the tracks.
        recent: scans of the last few seconds, oldest first, for tracks and advice that come late.
        advice: not followed yet, oldest first.
        lineage: epoch of the newest rebase followed since the start message; 0: none.
        rebases: told, and not followed yet.
        next_id: tracks with lower ids, which the start message did not name, are no more.
        known_id: tracks with lower ids have been heard of, from this or an earlier center.
        begun: tracks that began at a center whose start message has not come yet.
        maps: of each sensor's false plots; None for sensors that have none.
        ready: worked out ahead for the next scan, or None. It saves time and changes nothing.
        unusable: number of plots left out so far because no sensor can mean them.
    """

    epoch: int
    sequence: int
    tracks: Tracks
    recent: tuple[Look, ...]
    advice: tuple[Advice, ...] = ()
    lineage: int = 0
    rebases: tuple[Rebase, ...] = ()
    next_id: int = 0
    known_id: int = 0
    begun: tuple[Begin, ...] = ()
    maps: tuple[ClutterMap | None, ...] = ()
    ready: Ready | None = None
    unusable: int = 0


class Schedule(NamedTuple):
    """Scan times of the whole network, which ``dkf`` must know beforehand.

    Attributes:
        times_ns: ascending.
        sensors: for every time, the numbers of the sensors that scan then.
    """

    times_ns: Sequence[int]
    sensors: Sequence[tuple[int, ...]]


def left(look: Look) -> Look:
    """A scan for tracks that begin later: false plots are the denser, the more the others claim them."""
    if look.log_free is None:
        return look
    relative = look.plots.log_relative
    more = -look.log_free if relative is None else relative - look.log_free
    return look._replace(plots=look.plots._replace(log_relative=more))


def with_before(look: Look, beliefs: Beliefs) -> Look:
    """A scan that more tracks, or the same tracks anew, have worked in."""
    if look.before is not None:
        others = take(look.before, ~np.isin(look.before.ids, beliefs.ids))
        beliefs = concatenate(others, beliefs)
    return look._replace(before=take(beliefs, np.argsort(beliefs.ids)))


def put_tracks(tracks: Tracks, rows: BoolArray, part: Tracks) -> Tracks:
    """The tracks with the chosen rows replaced by those of ``part``, whatever the numbers of components."""
    tracks, part = alike(tracks, part)
    return put(tracks, rows, part)


def alike(first: Tracks, second: Tracks) -> tuple[Tracks, Tracks]:
    """Both with the same number of components; those that are added are none."""
    size = max(first.log_w.shape[1], second.log_w.shape[1])
    return _grown(first, size), _grown(second, size)


def _grown(tracks: Tracks, size: int) -> Tracks:
    more = size - tracks.log_w.shape[1]
    if not more:
        return tracks
    absent = np.full((len(tracks.ids), more), -np.inf)

    def filled(array: Array) -> Array:
        return np.concatenate([array, np.repeat(array[:, :1], more, axis=1)], axis=1)

    return tracks._replace(
        log_w=np.concatenate([tracks.log_w, absent], axis=1),
        log_g=np.concatenate([tracks.log_g, absent], axis=1),
        x=filled(tracks.x),
        P=filled(tracks.P),
        x_a=filled(tracks.x_a),
        P_a=filled(tracks.P_a),
    )
