"""Tests that need more than a plain machine are skipped where it is lacking, or fail where they must run."""

from __future__ import annotations

import os

import pytest

from benchmarks.namespaces import Namespaces


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Look for what network namespaces need; ``WALDNET_MUST_RUN=netns`` says that it must be there."""
    if item.get_closest_marker("netns") is None or not (lacking := Namespaces.lacking()):
        return
    if "netns" in os.environ.get("WALDNET_MUST_RUN", ""):
        pytest.fail(f"network namespaces need {lacking}")
    pytest.skip(f"network namespaces need {lacking}")
