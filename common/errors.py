"""Every error a user can meet.

::

    WaldnetError
    ├── ConfigError          a scenario or network file is wrong; every fault listed
    ├── PlotsError           a file of recorded plots is wrong; file and line named
    ├── DecodeError          bytes that are no message of ours
    │   └── VersionError     a message of another wire version
    ├── TransportError       the network: endpoint taken, nothing answers
    ├── TruthError           a file of true positions is wrong; file and line named
    ├── EvaluationError      a run to evaluate is wrong; file and line named
    ├── StudyError           workers of a study died, or are of another version
    └── LaunchError          a process of a run did not start, or died (waldnet/launch/processes.py)
"""

from __future__ import annotations


class WaldnetError(Exception):
    """Base of all errors that are not our own bugs."""


class ConfigError(WaldnetError):
    """A scenario or network file is wrong; the message lists every fault with its path."""


class PlotsError(WaldnetError):
    """A file of recorded plots is wrong; the message names file and line."""


class PlotsWarning(UserWarning):
    """A file of recorded plots may not mean what it is read as; the message names file and line."""


class DecodeError(WaldnetError):
    """Bytes that are no message of ours: what was got and what was expected."""


class VersionError(DecodeError):
    """A message of another wire version."""


class TransportError(WaldnetError):
    """The network does not do what was asked: an endpoint is taken, nothing answers."""


class TruthError(WaldnetError):
    """A file of true positions is wrong; the message names file and line."""


class EvaluationError(WaldnetError):
    """A run to evaluate is wrong, or it and the truth do not belong together; the message names file and line."""


class StudyError(WaldnetError):
    """A study cannot go on: a worker died, or is of another version."""
