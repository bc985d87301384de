"""Sensors scattered over a network decide together, by Wald's sequential test, which tracks are real.

The names below are the library: scenarios, scans, pictures of the tracks, their evaluation; ``waldnet.estimation``
holds the filters and tests by themselves. All are loaded when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from waldnet import estimation as estimation
    from waldnet.common.config import Scenario as Scenario
    from waldnet.common.errors import ConfigError as ConfigError
    from waldnet.common.errors import EvaluationError as EvaluationError
    from waldnet.common.errors import PlotsError as PlotsError
    from waldnet.common.errors import TruthError as TruthError
    from waldnet.common.errors import WaldnetError as WaldnetError
    from waldnet.library import Decision as Decision
    from waldnet.library import Picture as Picture
    from waldnet.library import Scan as Scan
    from waldnet.library import Track as Track
    from waldnet.library import columns as columns
    from waldnet.library import evaluate as evaluate
    from waldnet.library import load_scenario as load_scenario
    from waldnet.library import read_plots as read_plots
    from waldnet.library import replay as replay
    from waldnet.library import scenario_names as scenario_names
    from waldnet.library import simulate as simulate
    from waldnet.library import simulate_truth as simulate_truth

__all__ = [
    "ConfigError",
    "Decision",
    "EvaluationError",
    "Picture",
    "PlotsError",
    "Scan",
    "Scenario",
    "Track",
    "TruthError",
    "WaldnetError",
    "columns",
    "estimation",
    "evaluate",
    "load_scenario",
    "read_plots",
    "replay",
    "scenario_names",
    "simulate",
    "simulate_truth",
]

if not TYPE_CHECKING:

    def __getattr__(name):
        """Load a name of the library."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module = import_module("waldnet.estimation" if name == "estimation" else "waldnet.library")
        value = globals()[name] = module if name == "estimation" else getattr(module, name)
        return value

    def __dir__():
        """All names, loaded or not."""
        return sorted({*globals(), *__all__})
