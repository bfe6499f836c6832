"""One site of the fleet, to be read like the record of a pier of one's own."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from daemon.config.outputs import FleetSection
from daemon.errors import UsageError
from daemon.fleet.opening import opened
from daemon.outputs.row_fields import slug


@dataclass(frozen=True, slots=True)
class FetchedSite:
    """Where a site's copy is."""

    state: Path
    config: Path
    """What the pier shares of its own."""


def fetch(settings: FleetSection, name: str) -> FetchedSite:
    """Bring the copy of a site's record up to date.

    Raises UsageError for a name that is none; ConfigError, StoreError, OSError.
    """
    from daemon.store.central.replica import fetch_site
    from daemon.store.central.sites import read_sites, site_row

    with opened(settings) as central:
        site = site_row(central, name)
        if site is None:
            names = [one.name for one in read_sites(central)][:20]
            msg = f"--site {name}: the central database has no such site; it has {', '.join(names)}"
            raise UsageError(msg)
        state = cache_directory() / slug(name)
        fetch_site(central, site, state)
    config = state / "dcam.toml"
    config.write_text(site["config"] or "", encoding="utf-8")
    return FetchedSite(state, config)


def cache_directory() -> Path:
    """Where copies are kept; whoever removes them has them fetched again."""
    base = os.environ.get("CACHE_DIRECTORY") or os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "dcam" / "fleet"
