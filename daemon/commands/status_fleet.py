"""`dcam-ctl status --fleet` and `--site`: how sites are, by the central database."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict

from daemon.commands.options import Options
from daemon.commands.output import one_line, print_json, print_table, say
from daemon.fleet.opening import opened
from daemon.fleet.sums import FleetSums, sums_of
from daemon.fleet.verdict import SiteVerdict, fleet_level, judge_fleet
from daemon.status.item import Level
from daemon.store.central.sites import read_sites
from daemon.text import utc_text

MOST_LINES = 50
"""Of the list for people; --json has all."""


def look_at_fleet(options: Options, *, as_json: bool) -> Level:
    """Print all sites; give the worst level. Raises ConfigError, CentralAwayError, StoreError."""
    settings = options.centre.fleet
    with opened(settings) as central:
        found = judge_fleet(read_sites(central), settings.silent_min * 60.0)
    level, sums = fleet_level(found), sums_of(found, settings.silent_min * 60.0)
    if as_json:
        print_json(
            {
                "command": "status",
                "level": level.name.lower(),
                "code": level,
                "sums": asdict(sums),
                "sites": [_fields(one) for one in found],
            }
        )
        return level
    counts = Counter(one.level for one in found)
    said = ", ".join(f"{counts[one]} {one.name.lower()}" for one in Level if counts[one])
    say(f"DCAM {level.name} - {len(found)} sites: {said or 'none yet'}")
    say(_sums_text(sums))
    say()
    shown = found[:MOST_LINES]
    rows = [(one.site.name, one.level.name.lower(), _slot(one), one.text) for one in shown]
    print_table(("site", "state", "last slot", "what"), rows)
    if len(found) > len(shown):
        say(f"and {len(found) - len(shown)} more; --json has all")
    return level


def _sums_text(sums: FleetSums) -> str:
    return (
        f"measuring: {sums.measuring}; no new rows: {sums.stale}; not heard from: {sums.silent}; "
        f"with alarms: {sums.sites_with_alarms} ({sums.alarms} raised)"
    )


def look_at_site(options: Options, *, as_json: bool) -> Level:
    """Print how one site said it was at its last sync. Raises as `look_at_fleet`, UsageError."""
    from daemon.fleet.site import known_site, site_verdict

    settings, name = options.centre.fleet, str(options.site)
    with opened(settings) as central:
        said = known_site(central, name)["status"] or {}
        found = site_verdict(central, name, settings.silent_min * 60.0)
    heard_utc = found.site.heard_utc.replace(microsecond=0)
    if as_json:
        of_centre = {"level": found.level.name.lower(), "code": found.level, "text": found.text}
        print_json({"command": "status", **said, "site": name, "heard_utc": heard_utc, **of_centre})
        return found.level
    say(one_line(f"DCAM {found.level.name} - {name}: {found.text}"))
    say()
    say(f"heard {utc_text(heard_utc)}; what its pier said then:")
    items = said.get("items", ())
    print_table(("what", "state", ""), [(one["name"], one["level"], one["text"]) for one in items])
    return found.level


def _slot(one: SiteVerdict) -> str:
    last_utc = one.site.last_slot_utc
    return utc_text(last_utc) if last_utc else "-"


def _fields(one: SiteVerdict) -> dict[str, object]:
    site = one.site
    latitude_deg, longitude_deg = site.position_deg or (None, None)
    return {
        "site": site.name,
        "level": one.level.name.lower(),
        "text": one.text,
        "heard_utc": site.heard_utc,
        "last_slot_utc": site.last_slot_utc,
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "version": site.version,
        "alarms": site.alarms,
    }
