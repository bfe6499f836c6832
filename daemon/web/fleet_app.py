"""`dcam-web --fleet`: all sites of the central database, as a list and a map; each site's page."""

from __future__ import annotations

import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass
from typing import Any

import anyio.to_thread
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Mount, Route
from starlette.types import Receive, Scope, Send

from daemon.config.centre import Centre
from daemon.config.reading import Installation, load_config
from daemon.error_report import lines_of
from daemon.errors import DcamError
from daemon.fleet.opening import opened
from daemon.fleet.site import pages_directory
from daemon.fleet.sums import sums_of
from daemon.fleet.verdict import SiteVerdict, fleet_level, judge_fleet
from daemon.outputs.row_fields import slug
from daemon.web.answers import as_json, respond
from daemon.web.app import THREADS, handlers, site_app
from daemon.web.asking import only
from daemon.web.central_page import CentralPage
from daemon.web.guard import Guard
from daemon.web.settings import Settings, viewers
from daemon.web.site_copy import SiteCopy
from daemon.web.static_files import StaticFiles
from daemon.web.views import HERE, Views, texts_of

KEPT_S = 5.0
"""However many look: the list is read once in this time."""
MOST_SITES = 8
"""Whose pages are open at a time; the one that nobody looked at for longest is closed."""
_PATIENCE_S = 2.0
"""For a copy to be there: most are brought up to date in less."""


@dataclass(slots=True)
class _Open:
    copy: SiteCopy
    page: CentralPage | None = None
    app: Starlette | None = None


class FleetPage:
    """All sites, and the pages of those that are looked at."""

    def __init__(self, centre: Centre) -> None:
        self.centre = centre
        language = centre.web.language
        self.views = Views(
            "dcam", "UTC", language, texts_of(language), pages={}, has_site_time=False
        )
        self._open: dict[str, _Open] = {}
        self._names: dict[str, str] = {}
        self._lock = threading.Lock()
        self._kept: tuple[float, bytes] = (-KEPT_S, b"")

    # The list

    def list_page(self, _request: Request) -> HTMLResponse:
        """The first page."""
        return self.views.html("fleet")

    def sites(self, request: Request) -> Response:
        """Answer `/api/sites`."""
        only(request.query_params)
        return respond(request, self._sites())

    def _sites(self) -> bytes:
        with self._lock:
            made_s, body = self._kept
            if time.monotonic() - made_s >= KEPT_S:
                body = as_json(self._read_sites())
                self._kept = time.monotonic(), body
            return body

    def _read_sites(self) -> dict[str, Any]:
        from daemon.store.central.sites import read_sites

        settings = self.centre.fleet
        silent_s = settings.silent_min * 60.0
        with opened(settings) as central:
            found = judge_fleet(read_sites(central), silent_s)
        self._names = {slug(one.site.name): one.site.name for one in found}
        return {
            "schema": 1,
            "level": int(fleet_level(found)),
            "sums": asdict(sums_of(found, silent_s)),
            "sites": [_fields(one) for one in found],
        }

    # The pages of sites

    async def site(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer `/sites/NAME/...` by the site's page, once its copy is there."""
        root = str(scope["root_path"])
        named = str(scope["path"]).removeprefix(root).lstrip("/").partition("/")[0]
        inner = {**scope, "root_path": f"{root}/{named}"}
        app = await anyio.to_thread.run_sync(self._app, named, inner)
        await app(inner, receive, send)

    def _app(self, named: str, scope: Scope) -> Starlette | Response:
        name = self._name(named)
        if name is None:
            return self.views.message(scope, 404, f"there is no site {named}")
        with self._lock:
            one = self._opened(named, name)
        one.copy.first.wait(_PATIENCE_S)
        if one.copy.found is None:
            text = one.copy.trouble or f"the record is being fetched: {one.copy.rows} rows so far"
            is_browser = "text/html" in Headers(scope=scope).get("accept", "")
            status = 202 if is_browser and not one.copy.trouble else 503
            answer = self.views.message(scope, status, text)
            answer.headers["refresh"] = "3"
            return answer
        with self._lock:
            if one.app is None:
                try:
                    one.page = self._page(one.copy, str(scope["root_path"]))
                except DcamError as error:  # its config is none that this version can read
                    return self.views.message(scope, 503, "; ".join(lines_of(error)))
                one.page.follower.start()
                one.app = site_app(one.page)
            return one.app

    def _name(self, named: str) -> str | None:
        if named not in self._names:
            self._sites()  # a new one, or nobody has seen the list yet
        return self._names.get(named)

    def _opened(self, named: str, name: str) -> _Open:
        if named not in self._open:
            while len(self._open) >= MOST_SITES:
                oldest = min(self._open, key=lambda key: self._open[key].copy.looked_s)
                _close(self._open.pop(oldest))
            self._open[named] = _Open(SiteCopy(self.centre.fleet, name))
            self._open[named].copy.start()
        one = self._open[named]
        one.copy.looked_s = time.monotonic()
        return one

    def _page(self, copy: SiteCopy, root: str) -> CentralPage:
        assert copy.found is not None  # noqa: S101 - asked before
        found = copy.found
        site = Installation(found.config, load_config(found.config), found.state)
        settings = Settings(site, pages_directory() / slug(copy.site))
        return CentralPage(settings, copy, root)

    def close(self) -> None:
        """End all threads and workers."""
        for one in self._open.values():
            _close(one)


def _close(one: _Open) -> None:
    one.copy.stop()
    if one.page is not None:
        one.page.follower.stop()
        one.page.analyses.end()
        one.page.worker.end()


def _fields(one: SiteVerdict) -> dict[str, Any]:
    site = one.site
    latitude_deg, longitude_deg = site.position_deg or (None, None)
    return {
        "site": site.name,
        "level": int(one.level),
        "text": one.text,
        "heard": site.heard_utc,
        "last_slot": site.last_slot_utc,
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "page": f"/sites/{slug(site.name)}/",
    }


def build_fleet_app(centre: Centre) -> Starlette:
    """The page of all sites."""
    page = FleetPage(centre)

    @asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        anyio.to_thread.current_default_thread_limiter().total_tokens = THREADS
        try:
            yield
        finally:
            await anyio.to_thread.run_sync(page.close)

    return Starlette(
        routes=[
            Route("/", page.list_page),
            Route("/api/sites", page.sites),
            Mount("/sites", app=page.site),
            Route("/static/{path:path}", StaticFiles(HERE / "static").answer),
        ],
        middleware=[Middleware(Guard, viewers=viewers(centre.web), refuse=page.views.message)],
        exception_handlers=handlers(page.views),
        lifespan=lifespan,
    )
