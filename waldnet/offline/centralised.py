"""One tracker that gets the plots of all sensors: what the same steps make of them where nothing is distributed.

Local filter, gate, association, start, test and end of the tracks are those of the network; the share of each track is
the whole, so that no evolution is relaxed and no product is formed. It is the yardstick for the network.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.estimation.batch import take
from waldnet.common.estimation.imm import Imm
from waldnet.common.estimation.pose import Outlook
from waldnet.common.estimation.sprt import DELETED
from waldnet.common.local_filter import HONEST, LocalFilter
from waldnet.common.messages import NEVER, Decision, Report, Scan, Start, Stop, Tracks
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.center import given
from waldnet.fusion_center.factors import Fuser, Heard
from waldnet.fusion_center.initiation import Initiation, Pairs, Unclaimed
from waldnet.fusion_center.life import Life
from waldnet.fusion_center.picture import Picture, shown
from waldnet.sensor_node.state import Schedule
from waldnet.sensor_node.state import State as Filtered
from waldnet.sensor_node.tracker import LocalTracker


class State(NamedTuple):
    """What the tracker keeps between two measurement times.

    Attributes:
        filtered: the tracks as the filter has them.
        picture: all tracks, with those to come and those just deleted.
        unclaimed: plots of the last seconds that no track claims, oldest first.
        next_id: of the next track that begins.
        outlooks: of the sensors.
        time_ns: of the picture.
        pairs: of confirmed tracks that are close to each other.
    """

    filtered: Filtered
    picture: Picture
    unclaimed: tuple[Unclaimed, ...]
    next_id: int
    outlooks: tuple[Outlook, ...]
    time_ns: int
    pairs: Pairs


@dataclass(frozen=True)
class Centralised:
    """The steps of a tracker for all sensors.

    Attributes:
        names: of the sensors.
        tracker: works in the scans of all of them.
        fuser: of a single factor, which is the track.
        hypotheses: the tracks given by the scenario.
        life: tests the tracks, and ends those that nobody sees.
        initiation: how further tracks start; None: they do not.
    """

    names: tuple[str, ...]
    tracker: LocalTracker
    fuser: Fuser
    hypotheses: Picture
    life: Life
    initiation: Initiation | None

    @classmethod
    def of(cls, scenario: Scenario) -> Centralised:
        """The tracker of a scenario, whatever its mode: what a network sends to whom has no meaning here."""
        local = replace(LocalFilter.of(scenario, HONEST), terms=1)
        tracker = LocalTracker.of(scenario, scenario.sensor_names[0], Schedule((), ()))
        terms = len(local.motion.models) if isinstance(local.motion, Imm) else 1
        whole = Fuser.of(scenario)
        # Whatever the one factor says of a track, all sensors have seen it: nobody in here is blind.
        fuser = replace(whole, sensors=whole.sensors[:1], share=HONEST, terms=terms, globalised=False, configs=())
        return cls(
            names=scenario.sensor_names,
            tracker=replace(tracker, filter=local, rounding=None, selection=None, buffer_ns=0, schedule=None),
            fuser=fuser,
            hypotheses=given(scenario, fuser),
            life=Life.of(scenario),
            initiation=Initiation.of(scenario),
        )

    def initial(self) -> State:
        """Before the first scan."""
        none: Pairs = {}
        next_id, outlooks = len(self.hypotheses.ids), self.life.begin()
        return State(self.tracker.initial(), self.hypotheses, (), next_id, outlooks, -NEVER, none)

    def step(self, state: State, scans: Sequence[Scan]) -> tuple[State, list[Tracks | Decision]]:
        """Work in all scans of one measurement time, one after the other.

        Args:
            state: before.
            scans: of that time, at least one.

        Returns:
            the state after; what was decided, and the picture.
        """
        time_ns = scans[0].time_ns
        filtered, reports = self._told(state, time_ns), list[Report]()
        for scan in scans:
            filtered, report = self.tracker.scan(filtered, scan, NEVER)
            assert isinstance(report, Report), "no plots are selected"
            reports.append(report)
        # The last report has the evidence of all, and the tracks after all.
        expected, before = self.fuser.expect(state.picture, time_ns), state.picture
        whole = reports[-1]._replace(supported=np.any([report.supported for report in reports], axis=0))
        heard = self.fuser.heard(whole)
        assert isinstance(heard, Heard), "it is a report of this scenario"
        moved = self.fuser.advance(expected, {0: heard})
        told = {self.names.index(scan.sensor): scan.pose for scan in scans}
        outlooks = self.life.look(state.outlooks, told, time_ns - state.time_ns)
        picture, decisions = self.life.judge(moved, time_ns, outlooks)
        state = state._replace(filtered=filtered, picture=picture, outlooks=outlooks, time_ns=time_ns)
        if self.initiation is not None:
            now = [Unclaimed.of(self.names.index(report.sensor), report) for report in reports]
            state, merged = self._initiated(before, state, self.initiation, now)
            decisions += merged
        tracks = shown(state.picture, time_ns, self.names)
        scanned = np.isin(self.names, [scan.sensor for scan in scans])
        return state, [*decisions, tracks._replace(contributing=tracks.contributing & scanned)]

    def run(self, scans: Iterable[Scan]) -> Iterator[Tracks | Decision]:
        """Work in scans, by time; yields the picture after every measurement time, and the decisions before it."""
        state = self.initial()
        for _, group in groupby(scans, key=lambda scan: scan.time_ns):
            state, said = self.step(state, list(group))
            yield from said

    def _told(self, state: State, time_ns: int) -> Filtered:
        """The filter's tracks for the scans of a time: those that have started before and have not ended."""
        filtered, picture = state.filtered, state.picture
        live = (picture.status != DELETED) & (picture.starts_ns < time_ns)
        ended = np.setdiff1d(filtered.tracks.ids, picture.ids[live])
        filtered = self.tracker.stop(filtered, Stop("", ended))
        new = take(picture, live & ~np.isin(picture.ids, filtered.tracks.ids))
        density, zero = (new.x0, new.P0), np.zeros(len(new.ids))
        return self.tracker.start(filtered, Start("", filtered.epoch, new.ids, new.starts_ns, zero, *density, *density))

    def _initiated(
        self, before: Picture, state: State, initiation: Initiation, now: Sequence[Unclaimed]
    ) -> tuple[State, list[Decision]]:
        """Give up tracks that are another one, and begin those of the plots that none claims (theory.md §8)."""
        picture, pairs, merged = initiation.merged(before, state.picture, state.pairs)
        density = initiation.seeds(picture, now, state.unclaimed)
        ids, time_ns = state.next_id + np.arange(len(density.x)), now[0].time_ns
        picture = self.fuser.begin(picture, ids, np.full(len(ids), time_ns), density)
        oldest_ns = time_ns - round(initiation.config.within * NS_PER_S)
        kept = (scan for scan in (*state.unclaimed, *now) if scan.time_ns >= oldest_ns)
        next_id = state.next_id + len(ids)
        return state._replace(picture=picture, unclaimed=tuple(kept), next_id=next_id, pairs=pairs), merged
