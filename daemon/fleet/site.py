"""One site of the fleet, to be read like the record of a pier of one's own."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daemon.config.outputs import FleetSection
from daemon.durable import write_durable
from daemon.errors import UsageError
from daemon.fleet.opening import opened
from daemon.outputs.row_fields import slug
from daemon.store.queries.columns import Tell

if TYPE_CHECKING:
    from daemon.fleet.verdict import SiteVerdict
    from daemon.store.central.connecting import Central


@dataclass(frozen=True, slots=True)
class FetchedSite:
    """Where a site's copy is."""

    state: Path
    config: Path
    """What the pier shares of its own."""
    verdict: SiteVerdict
    status: Mapping[str, Any]
    """What its pier said of itself, as `status --json`; empty where it has not."""


def fetch(
    settings: FleetSection, name: str, tell: Tell = lambda _done, _total: None
) -> FetchedSite:
    """Bring the copy of a site's record up to date.

    Raises UsageError for a name that is none; ConfigError, StoreError, OSError.
    """
    from daemon.store.central.replica import fetch_site

    with opened(settings) as central:
        site = known_site(central, name)
        state = cache_directory() / slug(name)
        fetch_site(central, site, state, tell)
        verdict = site_verdict(central, name, settings.silent_min * 60.0)
    config = state / "dcam.toml"
    write_durable(config, (site["config"] or "").encode())
    return FetchedSite(state, config, verdict, site["status"] or {})


def site_verdict(central: Central, name: str, silent_s: float) -> SiteVerdict:
    """How a site is that is there. Raises CentralAwayError."""
    from daemon.fleet.verdict import judge_fleet
    from daemon.store.central.sites import read_sites

    (found,) = judge_fleet(read_sites(central, name), silent_s)
    return found


def known_site(central: Central, name: str) -> Mapping[str, Any]:
    """Everything that the central database has of a site itself.

    Raises UsageError for a name that is none; CentralAwayError.
    """
    from daemon.store.central.sites import read_sites, site_row

    site = site_row(central, name)
    if site is None:
        names = [one.name for one in read_sites(central)][:20]
        msg = f"--site {name}: the central database has no such site; it has {', '.join(names)}"
        raise UsageError(msg)
    return site


def cache_directory() -> Path:
    """Where copies are kept; whoever removes them has them fetched again."""
    return _cache() / "fleet"


def pages_directory() -> Path:
    """Where dcam-web keeps what it works out of each copy."""
    return _cache() / "pages"


def _cache() -> Path:
    base = os.environ.get("CACHE_DIRECTORY") or os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "dcam"
