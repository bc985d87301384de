"""What many tests share; those that need more than a plain machine are skipped where it is lacking."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from process_helpers import Processes

from waldnet.benchmarks.namespaces import Namespaces

# The same examples every time; WALDNET_EXPLORE=1 looks for new ones.
settings.register_profile("fixed", derandomize=True, deadline=None, database=None)
if not os.environ.get("WALDNET_EXPLORE"):
    settings.load_profile("fixed")


def pytest_addoption(parser: pytest.Parser) -> None:
    """The flag that writes the protocol traces anew."""
    parser.addoption("--rewrite-traces", action="store_true", help="write tests/traces/*.txt anew")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Look for what network namespaces need; ``WALDNET_MUST_RUN=netns`` says that it must be there."""
    if item.get_closest_marker("netns") is None or not (lacking := Namespaces.lacking()):
        return
    if "netns" in os.environ.get("WALDNET_MUST_RUN", ""):
        pytest.fail(f"network namespaces need {lacking}")
    pytest.skip(f"network namespaces need {lacking}")


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    """Real processes in a folder of their own, none of which outlives the test."""
    with Processes(tmp_path) as started:
        yield started
