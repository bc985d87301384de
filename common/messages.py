"""Every message and every key expression of the network, in one place.

Times are integer nanoseconds since the Unix epoch. Arrays lead with T, the number of tracks. The sensor's name of a
sensor's message is in its key, not in its payload.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from waldnet.common.estimation.gaussian import Array, BoolArray
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.estimation.sprt import StatusArray

IntArray = NDArray[np.int64]

#: No report will follow: a source that is exhausted.
NEVER = 2**63 - 1
#: Where a report has no such field.
_NOWHERE, _NO_PLOTS, _NOBODY = np.empty(0), np.empty((0, 0)), np.empty(0, np.bool_)


class Report(NamedTuple):
    """What a sensor node says after one scan: the factor of every track it keeps.

    A track's factor is a sum of terms ``e^g N(x; y, Y)`` (Eq. 17); the terms of all tracks stand one after the other.

    Attributes:
        sensor: who reports.
        sequence: number of the report since the node started.
        time_ns: time of the scan.
        next_ns: no later report of this sensor will be about an earlier time; NEVER ends the series.
        epoch: of the start message or rebase the factors descend from.
        ids: tracks, ascending, shape (T,).
        terms: number of terms of each track, shape (T,), sum N.
        log_g: cumulative log p_bar (with one term) or log evidence g, shape (N,).
        x: means, shape (N, n).
        P: covariances, shape (N, n, n).
        position: where the sensor stood [m], shape (d,); where tracks start or have a life only.
        unclaimed: plots that no track claims, from which tracks may start (theory.md §8), shape (U, m).
        velocity: of the sensor over ground [m/s], shape (d,); (0,) where it is not told.
        heading: of its platform [rad], clockwise from north.
        supported: tracks that the plots of the scan make at least twice as probable, shape (T,); where tracks have no
            life, shape (0,).
    """

    sensor: str
    sequence: int
    time_ns: int
    next_ns: int
    epoch: int
    ids: IntArray
    terms: IntArray
    log_g: Array
    x: Array
    P: Array
    position: Array = _NOWHERE
    unclaimed: Array = _NO_PLOTS
    velocity: Array = _NOWHERE
    heading: float = 0.0

    @property
    def pose(self) -> SensorPose:
        """Where the sensor was, and how it moved."""
        return SensorPose(self.position, self.velocity, self.heading)

    supported: BoolArray = _NOBODY


class Picked(NamedTuple):
    """What a sensor node says after one scan where the center tracks: the plots that matter, track by track.

    Attributes:
        sensor: who reports.
        sequence: number of the report since the node started.
        time_ns: time of the scan.
        next_ns: no later report of this sensor will be about an earlier time; NEVER ends the series.
        epoch: of the start message the tracks descend from.
        position: where the sensor stood [m], shape (d,).
        ids: tracks, ascending, shape (T,).
        plots: number of plots that matter to each track, shape (T,), sum N.
        which: their places in z, track after track, shape (N,).
        z: plots that matter to any track, shape (M, m).
        unclaimed: plots that no track claims, from which tracks may start (theory.md §8), shape (U, m).
        velocity: of the sensor over ground [m/s], shape (d,); (0,) where it is not told.
        heading: of its platform [rad], clockwise from north.
    """

    sensor: str
    sequence: int
    time_ns: int
    next_ns: int
    epoch: int
    position: Array
    ids: IntArray
    plots: IntArray
    which: IntArray
    z: Array
    unclaimed: Array
    velocity: Array = _NOWHERE
    heading: float = 0.0

    @property
    def pose(self) -> SensorPose:
        """Where the sensor was, and how it moved."""
        return SensorPose(self.position, self.velocity, self.heading)


class Scan(NamedTuple):
    """All plots of one sensor at one time; on the wire for display and recording.

    Attributes:
        sensor: who saw it.
        time_ns: time of the scan.
        position: where the sensor stood [m], shape (d,).
        z: plots, shape (M, m); azimuths count from north.
        velocity: of the sensor over ground [m/s], shape (d,); (0,) where it is not told.
        heading: of its platform [rad], clockwise from north.
    """

    sensor: str
    time_ns: int
    position: Array
    z: Array
    velocity: Array = _NOWHERE
    heading: float = 0.0

    @property
    def pose(self) -> SensorPose:
        """Where the sensor was, and how it moved."""
        return SensorPose(self.position, self.velocity, self.heading)


class Join(NamedTuple):
    """A sensor node is ready and asks for the tracks.

    Attributes:
        sensor: who joins.
        incarnation: random number of the process: a restarted node has lost its factors, a reconnected one has not.
        next_ns: no report of this sensor will be about an earlier time.
        digest: of the scenario, which must be the center's.
        epoch: the newest that the node has heard of, from this or an earlier center; a new center goes on above it.
        next_id: the node has heard of tracks with ids below this one; a new center gives none of them again.
    """

    sensor: str
    incarnation: int
    next_ns: int
    digest: str
    epoch: int = 0
    next_id: int = 0


class Start(NamedTuple):
    """Tracks to keep from a time on; to a sensor that comes back, with the factors the center holds for it.

    Attributes:
        sensor: whom it concerns.
        epoch: a node takes over a track it keeps already only from a higher epoch.
        ids: tracks, ascending, shape (T,).
        times_ns: times of the densities; scans later than this are used, shape (T,).
        log_p_bar: cumulative log p_bar so far, shape (T,).
        x, P: factors, shapes (T, n), (T, n, n).
        x_a, P_a: association filters, same shapes.
        next_id: tracks that begin later have this id or a higher one.
    """

    sensor: str
    epoch: int
    ids: IntArray
    times_ns: IntArray
    log_p_bar: Array
    x: Array
    P: Array
    x_a: Array
    P_a: Array
    next_id: int = NEVER


class Begin(NamedTuple):
    """Tracks that all nodes keep from a time on, begun from plots that none claimed, and tracks that claim no more.

    A deleted track stays with the nodes until no late report can undo that; the plots of its target, if there is one
    after all, start another one (theory.md §8).

    Attributes:
        epoch: nodes that follow this center have a higher one.
        given_ns: measurement time at which the center gives it.
        ids: tracks, ascending, shape (T,).
        times_ns: times of the densities; scans later than this are used, shape (T,).
        x, P: densities, of which each factor takes its share, shapes (T, n), (T, n, n).
        ended: tracks that were deleted, ascending, shape (E,).
    """

    epoch: int
    given_ns: int
    ids: IntArray
    times_ns: IntArray
    x: Array
    P: Array
    ended: IntArray


class Stop(NamedTuple):
    """Tracks that a sensor shall forget, ids of shape (T,)."""

    sensor: str
    ids: IntArray


class Advice(NamedTuple):
    """Fused tracks for the association filters (theory.md §6).

    Attributes:
        given_ns: measurement time at which the center gives it.
        time_ns: of the fused tracks.
        ids: tracks, ascending, shape (T,).
        x, P: fused densities, shapes (T, n), (T, n, n).
    """

    given_ns: int
    time_ns: int
    ids: IntArray
    x: Array
    P: Array


class Rebase(NamedTuple):
    """Fused tracks from which all factors begin anew (theory.md §3).

    Attributes:
        epoch: of the reports that descend from it.
        after_ns: scans later than this do.
        time_ns: of the fused tracks, when the center tells it.
        ids: tracks, ascending, shape (T,).
        x, P: fused densities, of which each factor takes its share, shapes (T, n), (T, n, n).
    """

    epoch: int
    after_ns: int
    time_ns: int
    ids: IntArray
    x: Array
    P: Array


class Clock(NamedTuple):
    """How scenario time runs, for sources that have no clock of their own.

    Attributes:
        time_ns: measurement time at ``wall_ns``; in lockstep the newest one worked in.
        wall_ns: instant of the wall clock: the clock's beginning or, for a node that joins later, when it is told.
        speed: seconds of measurement time per second; 0: lockstep, scans up to ``clear_ns`` may be processed.
        clear_ns: the earliest time any sensor will report next; NEVER: all sources are exhausted.
    """

    time_ns: int
    wall_ns: int
    speed: float
    clear_ns: int

    def due_ns(self, time_ns: int) -> int:
        """Instant of the wall clock at which a measurement time is there; not in lockstep."""
        return self.wall_ns + round((time_ns - self.time_ns) / self.speed)

    def present_ns(self, wall_ns: int) -> int:
        """Measurement time at an instant of the wall clock; not in lockstep."""
        return self.time_ns + round((wall_ns - self.wall_ns) * self.speed)


class Tracks(NamedTuple):
    """The fused picture after all reports of one measurement time.

    Attributes:
        time_ns: the measurement time.
        sensors: names of the sensors, in the order of ``contributing``.
        ids: tracks, ascending, shape (T,); those deleted at this time for the last time.
        status: 0 tentative, 1 confirmed, 2 deleted, 3 coasting: confirmed, but not seen lately, shape (T,).
        scans: measurement times used so far, shape (T,).
        contributing: who reported the track at this time, shape (T, S).
        log_lr: of the test (theory.md §7), shape (T,).
        log_lr_total: the sum of all log Lambda since the start, shape (T,).
        x, P: fused densities, shapes (T, n), (T, n, n).
        supported_ns: time of the last scan with a plot that was the track's, the start at first, shape (T,).
    """

    time_ns: int
    sensors: tuple[str, ...]
    ids: IntArray
    status: StatusArray
    scans: IntArray
    contributing: BoolArray
    log_lr: Array
    log_lr_total: Array
    x: Array
    P: Array
    supported_ns: IntArray


DecisionKind: TypeAlias = Literal["confirmed", "deleted", "lost", "merged", "withdrawn"]


class Decision(NamedTuple):
    """One decision about one track.

    Attributes:
        kind: confirmed; deleted: the test accepted that there is no target; lost: no sensor can see where it may be,
            or nobody knows any more where that is; merged: it was another track's target; or withdrawn: a late report
            undid what was decided.
        track: its id.
        time_ns: measurement time of the data that decided.
        log_lr: that crossed the threshold.
        log_lr_total: sum of all log Lambda since the start.
        scans: measurement times used since the start.
        into: of a merged track, the one that stays; else -1.
    """

    kind: DecisionKind
    track: int
    time_ns: int
    log_lr: float
    log_lr_total: float
    scans: int
    into: int = -1


#: From a sensor node to the center.
ToCenter: TypeAlias = Join | Report | Picked
#: From the center to one node: that of the sensor which the message names.
ToNode: TypeAlias = Start | Stop
#: From the center to all nodes.
ToNodes: TypeAlias = Begin | Advice | Rebase
Message: TypeAlias = ToCenter | ToNode | ToNodes | Scan | Clock | Tracks | Decision


class Keys(NamedTuple):
    """Key expressions of one network."""

    network: str

    def report(self, sensor: str = "*") -> str:
        """Sensor node to center."""
        return f"waldnet/{self.network}/sensor/{sensor}/report"

    def plots(self, sensor: str = "*") -> str:
        """Sensor node to whoever displays or records."""
        return f"waldnet/{self.network}/sensor/{sensor}/plots"

    def join(self, sensor: str = "*") -> str:
        """Sensor node to center."""
        return f"waldnet/{self.network}/sensor/{sensor}/join"

    def about(self, sensor: str = "*") -> str:
        """Queryable of a sensor node: its model as JSON."""
        return f"waldnet/{self.network}/sensor/{sensor}/about"

    def sensor_alive(self, sensor: str = "*") -> str:
        """Liveliness token of a sensor node."""
        return f"waldnet/{self.network}/alive/sensor/{sensor}"

    def center_alive(self) -> str:
        """Liveliness token of the center."""
        return f"waldnet/{self.network}/alive/center"

    def command(self, sensor: str = "*") -> str:
        """Center to one node: start, stop."""
        return f"waldnet/{self.network}/center/command/{sensor}"

    def clock(self) -> str:
        """Center to nodes."""
        return f"waldnet/{self.network}/center/clock"

    def advice(self) -> str:
        """Center to nodes."""
        return f"waldnet/{self.network}/center/advice"

    def tracks(self) -> str:
        """Center to all."""
        return f"waldnet/{self.network}/center/tracks"

    def notice(self) -> str:
        """Center to all: what somebody should look after, as JSON (``common.notice``)."""
        return f"waldnet/{self.network}/center/notice"

    def decision(self) -> str:
        """Center to all."""
        return f"waldnet/{self.network}/center/decision"

    def picture(self) -> str:
        """Queryable of the center: the newest tracks."""
        return f"waldnet/{self.network}/center/picture"

    def of(self, message: Message) -> str:
        """Where a message is published."""
        match message:
            case Report() | Picked():
                return self.report(message.sensor)
            case Scan():
                return self.plots(message.sensor)
            case Join():
                return self.join(message.sensor)
            case Start() | Stop():
                return self.command(message.sensor)
            case Begin() | Advice() | Rebase():
                return self.advice()
            case Clock():
                return self.clock()
            case Tracks():
                return self.tracks()
            case Decision():
                return self.decision()


def sensor_of(key: str) -> str:
    """Name of the sensor that a key is about; empty for other keys."""
    match key.split("/"):
        case ["waldnet", _, "sensor", sensor, _] | ["waldnet", _, "center", "command", sensor]:
            return sensor
        case ["waldnet", _, "alive", "sensor", sensor]:
            return sensor
        case _:
            return ""
