"""What display data may take of a slow link."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from waldnet.common.allowance import Allowance

Puts = st.lists(st.tuples(st.floats(0.0, 5.0), st.integers(0, 30_000), st.booleans()), max_size=60)


@given(Puts)
def test_display_takes_no_more_than_the_rate_leaves_and_what_is_due_always_goes(
    puts: list[tuple[float, int, bool]],
) -> None:
    now, shown, largest = 0.0, 0, 0
    allowance = Allowance(64e3, lambda: now)
    for wait_s, size, display in puts:
        now += wait_s
        if not display:
            allowance.spend(size)
        elif allowance.grants(size):
            shown, largest = shown + size, max(largest, size)
    assert shown <= 5600.1 * (now + 2.0) + largest


def test_reports_come_before_display() -> None:
    now = 0.0
    allowance = Allowance(64e3, lambda: now)
    allowance.spend(20_000)
    assert not allowance.grants(1)
    now = 3.0
    assert allowance.grants(100)


def test_what_is_larger_than_a_second_of_the_link_goes_when_it_is_idle() -> None:
    now = 0.0
    allowance = Allowance(64e3, lambda: now)
    assert allowance.grants(16_000)
    now = 1.0
    assert not allowance.grants(16_000)
    now = 2.0
    assert allowance.grants(16_000)


def test_regular_reports_do_not_starve_display() -> None:
    now, shown = 0.0, 0
    allowance = Allowance(64e3, lambda: now)
    for step in range(100):
        now = 0.5 * step
        allowance.spend(750)
        shown += 16_000 * allowance.grants(16_000)
    assert shown == pytest.approx(50 * (5600 - 1500), rel=0.15)


def test_without_a_rate_everything_is_granted() -> None:
    allowance = Allowance(None, lambda: 0.0)
    assert all(allowance.grants(10**9) for _ in range(1000))
