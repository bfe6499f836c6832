"""The page of one site as the central database knows it: no frames, no cameras, no disk there."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from daemon.fleet.site import FetchedSite
from daemon.status.item import Level
from daemon.web.app import Page
from daemon.web.overview import Overviews, points_of, verdict_fields
from daemon.web.record import Record
from daemon.web.settings import Settings
from daemon.web.site_copy import SiteCopy
from daemon.web.views import SITE_PAGES, Views

_NOT_THERE = frozenset({"/metrics", "/aim", "/aim/{name}", "/api/aim"})
"""What only a pier knows."""


class CentralPage(Page):
    """A site's page, from a copy of its record."""

    def __init__(self, settings: Settings, copy: SiteCopy, root: str) -> None:
        super().__init__(settings, None)
        own = self.views
        texts = {**own.texts, "frame_gone": own.texts["frame_at_pier"]}
        texts["no_picture"] = own.texts["picture_at_pier"]
        pages = {name: path for name, path in SITE_PAGES.items() if name != "aim"}
        self.views: Views = replace(own, texts=texts, root=root, pages=pages)
        self.overviews = _SaidOverviews(self, copy)

    def alarms(self, _record: Record) -> dict[str, Any]:
        """None: they are raised, and sent, at the pier."""
        return {"schema": 1, "alarms": []}

    def days(self, request: Request) -> Response:
        """Answer `/api/days`, without pictures."""
        return self.answer_days(request, pictures=False)

    def offers(self, path: str) -> bool:
        """Whether there is such a page of a site in the centre."""
        return path not in _NOT_THERE


class _SaidOverviews(Overviews):
    """How a site is, as its pier said at its last sync."""

    def __init__(self, page: Page, copy: SiteCopy) -> None:
        super().__init__(page.settings, page.follower)
        self._copy = copy

    def _collected(self) -> dict[str, Any]:
        found = self._copy.found
        assert found is not None  # noqa: S101 - the page is shown once it is there
        status, now_utc = found.status, datetime.now(UTC)
        level, items = found.verdict.level, _items(found)
        if self._copy.trouble:  # how it is now nobody knows
            level = Level.UNKNOWN
            items.insert(0, _item("central database", level, self._copy.trouble))
        return {
            **self.site(),
            **verdict_fields(level, items),
            "last": _last(status.get("last"), now_utc),
            "coverage": {
                "h24": _share(status.get("coverage_24h")),
                "d30": _share(status.get("coverage_30d")),
            },
            "disk": status.get("disk"),
            "alarms": [],
        }


def _items(found: FetchedSite) -> list[dict[str, Any]]:
    """What the pier said, and before it what the centre says: when it was heard."""
    said = [
        _item(one["name"], Level[one["level"].upper()], one["text"])
        for one in found.status.get("items", ())
    ]
    heard_utc = found.verdict.site.heard_utc.astimezone(UTC)
    text = f"{heard_utc:%Y-%m-%d %H:%M} UTC; all of this is as of then"
    level = Level.CRITICAL if found.verdict.silent else Level.OK
    return [_item("heard", level, text), *said]


def _item(name: str, level: Level, text: str) -> dict[str, Any]:
    return {"name": name, "level": int(level), "text": text}


def _last(fields: dict[str, Any] | None, now_utc: datetime) -> dict[str, Any] | None:
    if fields is None:
        return None
    slot_utc = datetime.fromisoformat(fields["slot_utc"])
    age_s = (now_utc - slot_utc).total_seconds()
    return {"slot": slot_utc, "age_s": age_s, "points": points_of(fields)}


def _share(fields: dict[str, Any] | None) -> float | None:
    if not fields or not fields["expected"]:
        return None
    rows = sum(fields[name] for name in ("good", "suspect", "bad", "missing"))
    return float(rows / fields["expected"])
