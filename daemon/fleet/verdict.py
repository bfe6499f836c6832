"""Each site of a fleet with its level: the pier's own word, and whether it was heard at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from daemon.status.item import Level
from daemon.store.central.sites import CentralSite
from daemon.text import span_text

_ORDER = (Level.CRITICAL, Level.WARNING, Level.UNKNOWN, Level.OK)


@dataclass(frozen=True, slots=True)
class SiteVerdict:
    """A site and how it is."""

    site: CentralSite
    level: Level
    text: str
    silent: bool = False
    """It was not heard: the text says for how long, and what it said before."""


def judge_fleet(sites: Sequence[CentralSite], silent_s: float) -> list[SiteVerdict]:
    """All sites, worst first; of equal ones those that were silent for longest first."""
    found = [_judge(site, silent_s) for site in sites]
    return sorted(
        found, key=lambda one: (_ORDER.index(one.level), -one.site.silent_s, one.site.name)
    )


def _judge(site: CentralSite, silent_s: float) -> SiteVerdict:
    if site.silent_s > silent_s:
        text = f"not heard from for {span_text(site.silent_s)}"
        said = f"{text}; then: {site.summary or 'nothing'}"
        return SiteVerdict(site, Level.CRITICAL, said, silent=True)
    level = Level.UNKNOWN if site.level is None else Level(site.level)
    return SiteVerdict(site, level, site.summary)


def fleet_level(found: Sequence[SiteVerdict]) -> Level:
    """The worst of all."""
    return found[0].level if found else Level.UNKNOWN
