"""One site of the fleet, to be read like the record of a pier of one's own."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daemon.config.outputs import FleetSection
from daemon.errors import UsageError
from daemon.fleet.opening import opened
from daemon.outputs.row_fields import slug

if TYPE_CHECKING:
    from daemon.fleet.verdict import SiteVerdict
    from daemon.store.central.connecting import Central


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

    with opened(settings) as central:
        site = _known(central, name)
        state = cache_directory() / slug(name)
        fetch_site(central, site, state)
    config = state / "dcam.toml"
    config.write_text(site["config"] or "", encoding="utf-8")
    return FetchedSite(state, config)


def site_verdict(
    central: Central, name: str, silent_s: float
) -> tuple[SiteVerdict, Mapping[str, Any]]:
    """How a site is, and all that its pier said of itself. Raises as `fetch`."""
    from daemon.fleet.verdict import judge_fleet
    from daemon.store.central.sites import read_sites

    said = _known(central, name)["status"]
    (found,) = judge_fleet(read_sites(central, name), silent_s)
    return found, said or {}


def _known(central: Central, name: str) -> Mapping[str, Any]:
    from daemon.store.central.sites import read_sites, site_row

    site = site_row(central, name)
    if site is None:
        names = [one.name for one in read_sites(central)][:20]
        msg = f"--site {name}: the central database has no such site; it has {', '.join(names)}"
        raise UsageError(msg)
    return site


def cache_directory() -> Path:
    """Where copies are kept; whoever removes them has them fetched again."""
    base = os.environ.get("CACHE_DIRECTORY") or os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "dcam" / "fleet"
