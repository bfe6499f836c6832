"""A head that is aimed elsewhere than at its own zero: angles count from there, both ways."""

from __future__ import annotations

import pytest

from drivers.heads.home import HomedHead
from drivers.protocols import HeadReport

REPORT = HeadReport("a head", (12.0, -4.0), None, None)


class Head:
    """Goes where it is sent, in its own angles, if it knows where it is."""

    def __init__(self, *, reports_position: bool = True) -> None:
        self.reports_position = reports_position
        self.at = (0.0, 0.0)
        self.calls: list[str] = []

    def move_to(self, pan_deg: float, tilt_deg: float) -> None:
        self.at = (pan_deg, tilt_deg)

    def position_deg(self) -> tuple[float, float] | None:
        return self.at if self.reports_position else None

    def describe(self) -> HeadReport:
        return REPORT

    def halt(self) -> None:
        self.calls.append("halt")

    def close(self) -> None:
        self.calls.append("close")


def test_angles_count_from_home_both_ways() -> None:
    """Home is zero, and a move of half a degree is one; the head hears its own angles."""
    head = Head()
    homed = HomedHead(head, (12.0, -4.0))
    homed.move_to(0.0, 0.0)
    assert head.at == (12.0, -4.0)
    assert homed.position_deg() == (0.0, 0.0)
    homed.move_to(0.5, -0.25)
    assert head.at == (12.5, -4.25)
    assert homed.position_deg() == pytest.approx((0.5, -0.25))


def test_a_head_that_does_not_know_where_it_is_has_no_position_from_home() -> None:
    homed = HomedHead(Head(reports_position=False), (12.0, -4.0))
    assert not homed.reports_position
    assert homed.position_deg() is None


def test_it_is_halted_closed_and_described_as_the_head_itself() -> None:
    head = Head()
    homed = HomedHead(head, (12.0, -4.0))
    assert homed.reports_position
    assert homed.describe() is REPORT
    homed.halt()
    homed.close()
    assert head.calls == ["halt", "close"]
