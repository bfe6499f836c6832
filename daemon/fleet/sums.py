"""Sums over all sites: how many measure, how many do not, and what alarms they have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daemon.fleet.verdict import SiteVerdict
    from daemon.store.central.sites import CentralSite


@dataclass(frozen=True, slots=True)
class FleetSums:
    """Each site is measuring, stale or silent."""

    sites: int
    measuring: int
    """Heard, and its last slot is hardly older than that."""
    stale: int
    """Heard, but without new rows."""
    silent: int
    alarms: int
    """That are raised at sites, silent ones too."""
    sites_with_alarms: int


def sums_of(found: Sequence[SiteVerdict], silent_s: float) -> FleetSums:
    """Add sites up; `silent_s` as they were judged with."""
    heard = [one.site for one in found if not one.silent]
    measuring = sum(_is_measuring(site, silent_s) for site in heard)
    alarms = [one.site.alarms for one in found if one.site.alarms]
    return FleetSums(
        len(found),
        measuring,
        len(heard) - measuring,
        len(found) - len(heard),
        sum(alarms),
        len(alarms),
    )


def _is_measuring(site: CentralSite, silent_s: float) -> bool:
    return site.slot_age_s is not None and site.slot_age_s <= silent_s + site.period_s
