"""What was published in one run, in memory: of networks within one process, which are short."""

from __future__ import annotations

from dataclasses import dataclass, field

from waldnet.common.config import Scenario
from waldnet.common.messages import Decision, Message, Scan, Tracks


@dataclass
class Record:
    """Everything heard during one run.

    Attributes:
        scenario: what ran.
        pictures: of every measurement time; a late report replaces those from its time on.
        decisions: in the order they were made.
        scans: the plots as the sensors published them.
    """

    scenario: Scenario
    pictures: dict[int, Tracks] = field(default_factory=dict)
    decisions: list[Decision] = field(default_factory=list)
    scans: list[Scan] = field(default_factory=list)

    def note(self, message: Message) -> None:
        """Keep a message that belongs to the record."""
        match message:
            case Tracks():
                self.pictures[message.time_ns] = message
            case Decision():
                self.decisions.append(message)
            case Scan():
                self.scans.append(message)
            case _:
                pass

    def standing(self) -> list[Decision]:
        """Decisions that were not withdrawn."""
        kept: list[Decision] = []
        for decision in self.decisions:
            if decision.kind == "withdrawn":
                kept = [d for d in kept if (d.track, d.time_ns) != (decision.track, decision.time_ns)]
            else:
                kept.append(decision)
        return kept
