"""What the center keeps between two steps, and the events that move it."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, TypeAlias

from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.pose import Outlook
from waldnet.common.messages import NEVER, Clock, Decision, IntArray, Picked, Rebase, Report, ToCenter
from waldnet.fusion_center.factors import Expected, Heard
from waldnet.fusion_center.initiation import Pairs
from waldnet.fusion_center.picture import Backup, Picture
from waldnet.fusion_center.refusal import Refusal, Refused, add
from waldnet.fusion_center.selected import ExpectedTracks, HeardPlots


class Presence(NamedTuple):
    """A sensor's liveliness token came or went."""

    sensor: str
    alive: bool


class Tick(NamedTuple):
    """Time has passed."""


Event: TypeAlias = ToCenter | Presence | Tick


AnyHeard: TypeAlias = Heard | HeardPlots
AnyExpected: TypeAlias = Expected | ExpectedTracks


class AnyFuser(Protocol):
    """The steps of a picture: of factors (``Fuser``), or of the center's own tracks (``SelectedFuser``)."""

    def empty(self) -> Picture:
        """A picture without tracks."""
        ...

    def begin(self, picture: Picture, ids: IntArray, times_ns: IntArray, priors: Gaussian) -> Picture:
        """Add tracks."""
        ...

    def heard(self, report: Report | Picked) -> AnyHeard | Refusal:
        """A report taken apart, or why it cannot be computed with."""
        ...

    def backup(self, picture: Picture, number: int) -> Backup:
        """What a sensor that joins goes on from."""
        ...

    def rebased(self, now: Picture, then: Picture, told: Rebase) -> Picture:
        """The newest picture with factors that begin anew."""
        ...

    def expect(self, picture: Picture, t_ns: int) -> AnyExpected:
        """Work out what a picture will be at a measurement time, as far as no report is needed for it."""
        ...

    def advance(self, expected: Any, reports: Mapping[int, Any]) -> Picture:
        """Work in all reports of one measurement time."""
        ...


class Member(NamedTuple):
    """What the center knows of a sensor.

    Attributes:
        joined: it asked for the tracks.
        alive: it is there now.
        incarnation: of its process.
        epoch: its reports must carry.
        next_ns: nothing earlier will come from it.
        lineage: of its factors when it joined.
    """

    joined: bool = False
    alive: bool = False
    incarnation: int = 0
    epoch: int = 0
    next_ns: int = 0
    lineage: int = 0


class Begun(NamedTuple):
    """Tracks that began at one measurement time.

    Attributes:
        ids: ascending, shape (T,).
        density: shapes (T, n), (T, n, n).
    """

    ids: IntArray
    density: Gaussian


class Checkpoint(NamedTuple):
    """One measurement time, worked in.

    Attributes:
        time_ns: the measurement time.
        reports: by number of the sensor.
        picture: after them.
        decisions: made then.
        begun: tracks that began then; None: none ever do.
        lineage: epoch of the rebase that the factors of the picture descend from; 0: none.
        outlooks: of the sensors.
        pairs: log LR of two targets against one, of confirmed tracks that are close to each other, by their ids.
    """

    time_ns: int
    reports: Mapping[int, AnyHeard]
    picture: Picture
    decisions: tuple[Decision, ...]
    begun: Begun | None = None
    lineage: int = 0
    outlooks: tuple[Outlook, ...] = ()
    pairs: Pairs = MappingProxyType({})


class Told(NamedTuple):
    """A rebase that the nodes were told of.

    Attributes:
        rebase: as they were told.
        then: the picture of its time, once that is no more in the history.
    """

    rebase: Rebase
    then: Picture | None = None


class Waiting(NamedTuple):
    """Reports of one measurement time not worked in yet.

    Attributes:
        reports: by number of the sensor.
        since_ns: wall time at which the first one came, or, if that is later, at which it was due.
    """

    reports: Mapping[int, AnyHeard]
    since_ns: int


class Counts(NamedTuple):
    """What happened to reports that did not go the straight way.

    Attributes:
        late: worked in after their time, inside the window.
        too_late: dropped, older than the window.
        repeated: dropped, had arrived before.
        refused: dropped, do not fit this network.
        unusable_tracks: left out of reports, of which the rest was worked in: a factor is no Gaussian density, or
            beyond ``MAX_ESTIMATE``.
        unusable_plots: left out of reports, of which the rest was worked in: no sensor can mean them.
    """

    late: int = 0
    too_late: int = 0
    repeated: int = 0
    refused: int = 0
    unusable_tracks: int = 0
    unusable_plots: int = 0


class State(NamedTuple):
    """State of the center.

    Attributes:
        first_join_ns: wall time at which the wait for the other sensors began; None: nobody has joined.
        clock: once running.
        members: by number of the sensor.
        waiting: by measurement time.
        base: the picture before the oldest checkpoint.
        base_ns: its time.
        base_lineage: its lineage.
        base_outlooks: its outlooks.
        base_pairs: its pairs.
        history: checkpoints inside the window, oldest first.
        counts: of reports.
        refused: how often each sensor was refused for each reason; the sum is ``counts.refused``.
        told: the rebases that reports may descend from, oldest first.
        next_id: of the next track that begins.
        expected: worked out ahead for the next measurement time, or None. It saves time and changes nothing.
    """

    first_join_ns: int | None
    clock: Clock | None
    members: tuple[Member, ...]
    waiting: Mapping[int, Waiting]
    base: Picture
    base_ns: int
    history: tuple[Checkpoint, ...]
    counts: Counts
    refused: Refused = MappingProxyType({})
    base_lineage: int = 0
    base_outlooks: tuple[Outlook, ...] = ()
    base_pairs: Pairs = MappingProxyType({})
    told: tuple[Told, ...] = ()
    next_id: int = 0
    expected: AnyExpected | None = None

    @property
    def picture(self) -> Picture:
        """The newest picture."""
        return self.history[-1].picture if self.history else self.base

    @property
    def lineage(self) -> int:
        """Epoch of the rebase that the newest factors descend from."""
        return self.history[-1].lineage if self.history else self.base_lineage

    @property
    def outlooks(self) -> tuple[Outlook, ...]:
        """Of the sensors."""
        return self.history[-1].outlooks if self.history else self.base_outlooks

    @property
    def pairs(self) -> Pairs:
        """Log LR of two targets against one, of confirmed tracks that are close to each other."""
        return self.history[-1].pairs if self.history else self.base_pairs

    @property
    def time_ns(self) -> int:
        """The newest measurement time worked in."""
        return self.history[-1].time_ns if self.history else self.base_ns

    @property
    def finished(self) -> bool:
        """All sources are exhausted and everything is worked in."""
        return self.clock is not None and self.clock.clear_ns == NEVER

    def with_member(self, number: int, member: Member) -> State:
        """The state with another opinion of a sensor."""
        return self._replace(members=(*self.members[:number], member, *self.members[number + 1 :]))

    def counted(self, what: str, more: int = 1) -> State:
        """The state with so many more of a kind of ``Counts``."""
        if not more:
            return self
        return self._replace(counts=self.counts._replace(**{what: getattr(self.counts, what) + more}))

    def refuse(self, sensor: str, refusal: Refusal) -> State:
        """The state with one more refused report or request of a sensor."""
        return self.counted("refused")._replace(refused=add(self.refused, sensor, refusal))
