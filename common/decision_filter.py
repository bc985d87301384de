"""Which decisions people are told of: most tracks that start by themselves are of false plots and end unconfirmed."""

from __future__ import annotations

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.estimation.sprt import Status
from waldnet.common.messages import Decision, Tracks
from waldnet.common.quantities import NS_PER_S


class DecisionFilter:
    """Tells decisions on given hypotheses and on tracks that were confirmed from those on tracks that never were.

    It remembers the confirmed tracks that are alive, and those that ended within the window: a late report may still
    undo their end.
    """

    def __init__(self, scenario: Scenario, *, verbose: bool = False) -> None:
        """For one network.

        Args:
            scenario: for its hypotheses and the window of late reports.
            verbose: let all decisions pass.
        """
        self._given = len(scenario.hypotheses)
        self._window_ns = round(scenario.fusion.window * NS_PER_S)
        self._verbose = verbose
        self._confirmed: dict[int, int | None] = {}

    def __len__(self) -> int:
        """How many tracks are remembered."""
        return len(self._confirmed)

    def learn(self, picture: Tracks) -> None:
        """Remember the tracks that a picture tells to be confirmed, for whoever comes late."""
        undecided = (Status.TENTATIVE, Status.DELETED)
        self._confirmed.update(dict.fromkeys(picture.ids[~np.isin(picture.status, undecided)].tolist()))

    def passes(self, decision: Decision) -> bool:
        """Whether people are told of a decision; to be asked once, in the order in which decisions come."""
        alive = decision.kind in ("confirmed", "withdrawn")
        known = decision.kind == "confirmed" or decision.track in self._confirmed
        if known:
            self._confirmed[decision.track] = None if alive else decision.time_ns
        oldest_ns = decision.time_ns - self._window_ns
        for track, ended_ns in list(self._confirmed.items()):
            if ended_ns is not None and ended_ns < oldest_ns:
                del self._confirmed[track]
        return self._verbose or known or decision.track < self._given
