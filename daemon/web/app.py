"""The page: which address gives what."""

from __future__ import annotations

import base64
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, Response
from starlette.routing import Route

from daemon.errors import StoreError
from daemon.preview.shown import Shown
from daemon.times import slot_text
from daemon.web import asking, slots
from daemon.web.aim import StoredLook, live_fields
from daemon.web.analyses import Analyses, analysis_asked, span_fields
from daemon.web.answers import Answers, as_json, respond
from daemon.web.asking import AskedWronglyError, only
from daemon.web.follower import Follower
from daemon.web.guard import Guard
from daemon.web.metrics import CONTENT_TYPE, Metrics
from daemon.web.overview import Overviews, alarm_fields
from daemon.web.record import Record
from daemon.web.series import MOST_BUCKETS, Asked, newest_entry, quantities_of, series, spans
from daemon.web.settings import Settings
from daemon.web.static_files import StaticFiles
from daemon.web.views import HERE, Views, texts_of
from daemon.web.worker import Worker, WorkerError

THREADS = 4
"""For questions to the database: more would only take memory."""
FRAMES_DEADLINE_S = 180.0
"""For one look; the first one may have loops to compile, on a slow or busy computer."""
_PAGES = ("days", "analysis", "calibrations", "events", "aim")
_WIDTHS = (0, 160, 320, 960)


class Page:
    """Everything that answers share."""

    def __init__(self, settings: Settings, live: Shown | None) -> None:
        self.settings = settings
        self.live = live
        self.config = settings.site.config
        self.record = Record(settings.state)
        self.follower = Follower(settings.state, settings.cache, self.config.schedule.period_s)
        self.metrics = Metrics(settings)
        self.overviews = Overviews(settings, self.follower)
        self.answers = Answers()
        self.worker = Worker(
            "daemon.web.finder",
            settings.site.config_path,
            does="looking at frames",
            deadline_s=FRAMES_DEADLINE_S,
        )
        self.analyses = Analyses(settings)
        self.stored = StoredLook(self.record, self.worker)
        language = self.config.web.language
        timezone = self.config.site_section.timezone or "UTC"
        self.views = Views(self.config.name, timezone, language, texts_of(language))

    # HTML

    def overview_page(self, _request: Request) -> HTMLResponse:
        """The first page, with what its figures need to begin: one request less before them."""
        try:
            site = json.loads(as_json(self.overviews.site()))
        except (StoreError, OSError):  # the page asks again, and says why
            site = None
        return self.views.html("overview", begin=site)

    # JSON

    def answer(self, request: Request, make: Callable[[], Any], key: object = None) -> Response:
        """Bytes of what is made, kept under a key; what is asked wrongly is one line."""
        body = as_json(make()) if key is None else self.answers.json(key, make)
        return respond(request, body)

    def overview(self, request: Request) -> Response:
        """Answer `/api/overview`."""
        only(request.query_params)
        return self.answer(request, self.overviews.fields)

    def site(self, request: Request) -> Response:
        """Answer `/api/site`."""
        only(request.query_params)
        return self.answer(request, self.overviews.site)

    def series(self, request: Request) -> Response:
        """Answer `/api/series`."""
        query = request.query_params
        only(query, "quantities", "since", "until", "buckets", "without_excluded")
        names = quantities_of(query.get("quantities", "x_mm.main,y_mm.main"))
        since, until = asking.span(query, self._last_week)
        buckets = int(asking.number(query, "buckets", 2000, 1, MOST_BUCKETS))
        asked = Asked(names, since, until, buckets, asking.switch(query, "without_excluded"))
        self.follower.wait_current()
        said = newest_entry(self.record) if asked.without_excluded else None
        key = (asked, self.follower.progress(), said)
        return self.answer(request, lambda: series(self.record, self.follower.pyramid, asked), key)

    def spans(self, request: Request) -> Response:
        """Answer `/api/spans`."""
        query = request.query_params
        only(query, "since", "until", "resolution")
        since, until = asking.span(query, self._last_week)
        least_s = (until - since).total_seconds() / 2000
        resolution_s = asking.number(query, "resolution", least_s, 0, 1e9)
        resolution_s = max(resolution_s, least_s)
        self.follower.wait_current()
        return self.answer(
            request,
            lambda: spans(self.record, self.follower.pyramid, since, until, resolution_s),
            (since, until, resolution_s, self.follower.progress(), newest_entry(self.record)),
        )

    def slot(self, request: Request) -> Response:
        """Answer `/api/slot/...`."""
        only(request.query_params)
        slot_utc = asking.slot(request.path_params["slot"])
        found = slots.slot(self.record, slot_utc)
        if found is None:
            raise HTTPException(404, f"no row and no gap at {slot_text(slot_utc)}")
        return self.answer(request, lambda: found)

    def days(self, request: Request) -> Response:
        """Answer `/api/days`."""
        return self.answer_days(request, pictures=True)

    def answer_days(self, request: Request, *, pictures: bool) -> Response:
        """Days, with a picture of each where there may be any."""
        only(request.query_params, "since", "until")
        since, until = asking.span(request.query_params, lambda: self._last(60))
        if (until - since).days > slots.MOST_DAYS:
            msg = f"since: at most {slots.MOST_DAYS} days at once"
            raise AskedWronglyError(msg)
        self.follower.wait_current()
        pyramid, span = self.follower.pyramid, self.record.span()
        now_utc = span[1] if span and self.config.has_stepped_clock else datetime.now(UTC)
        return self.answer(
            request,
            lambda: slots.days(
                *(pyramid, self.config, span, since, until, now_utc),
                slots.excluded(self.record),
                pictures=pictures,
            ),
        )

    def listed(
        self, make: Callable[[Record, datetime, datetime], dict[str, Any]]
    ) -> Callable[[Request], Response]:
        """Answer with a list of a span; without one, of all times."""

        def answer(request: Request) -> Response:
            only(request.query_params, "since", "until")
            always = (asking.FIRST, asking.LAST)
            since, until = asking.span(request.query_params, lambda: always)
            return self.answer(request, lambda: make(self.record, since, until))

        return answer

    def whole(self, make: Callable[[Record], dict[str, Any]]) -> Callable[[Request], Response]:
        """Answer with what takes no parameter."""

        def answer(request: Request) -> Response:
            only(request.query_params)
            return self.answer(request, lambda: make(self.record))

        return answer

    def alarms(self, _record: Record) -> dict[str, Any]:
        """All alarms, those that are raised first."""
        return {"schema": 1, "alarms": alarm_fields(self.settings)}

    def _last(self, days: float) -> tuple[datetime, datetime]:
        span = self.record.span()
        end = (span[1] if span else datetime.now(UTC)) + timedelta(seconds=1)
        return end - timedelta(days=days), end

    def _last_week(self) -> tuple[datetime, datetime]:
        return self._last(7)

    def offers(self, _path: str) -> bool:
        """Whether there is such an address."""
        return True

    # Long work

    async def analysis(self, request: Request) -> Response:
        """Answer `/api/analysis`; without a span, of all rows."""
        always = (asking.FIRST, asking.LAST)
        asked = analysis_asked(
            request.query_params, asking.span(request.query_params, lambda: always)
        )
        found = await self.analyses.answer(asked)
        return self.answer(request, lambda: found)

    async def comparison(self, request: Request) -> Response:
        """Answer `/api/comparison`: beside the reference that `[report]` names."""
        only(request.query_params, "since", "until")
        always = (asking.FIRST, asking.LAST)
        span = span_fields(asking.span(request.query_params, lambda: always))
        found = await self.analyses.answer({"what": "comparison", **span})
        return self.answer(request, lambda: found)

    # Frames

    async def targets(self, request: Request) -> Response:
        """Answer `/api/slot/.../targets`: found again by the worker."""
        only(request.query_params)
        slot_utc = asking.slot(request.path_params["slot"])
        paths = {
            role: await anyio.to_thread.run_sync(self.record.frame, slot_utc, role)
            for role in ("main", "sub")
        }
        if None in paths.values():
            raise HTTPException(404, f"the frames of {slot_text(slot_utc)} are not kept")
        asked = {"what": "targets", **{role: str(path) for role, path in paths.items()}}
        found = (await self.worker.ask(asked))["targets"]
        return self.answer(request, lambda: {"schema": 1, **found})

    async def frame(self, request: Request) -> Response:
        """Answer `/frames/...`: the file itself if a browser shows it as it is, else a picture."""
        only(request.query_params, "width")
        slot_utc, role = asking.slot(request.path_params["slot"]), request.path_params["role"]
        if role not in {"main", "sub"}:
            raise HTTPException(404, "there are main and sub")
        width_px = int(asking.number(request.query_params, "width", 0, 0, 4096))
        if width_px not in _WIDTHS:
            msg = f"width: one of {', '.join(map(str, _WIDTHS))}"
            raise AskedWronglyError(msg)
        path = await anyio.to_thread.run_sync(self.record.frame, slot_utc, role)
        if path is None:
            raise HTTPException(404, f"the {role} frame of {slot_text(slot_utc)} is not kept")
        headers = {"cache-control": "private, max-age=86400"}
        if not width_px and await anyio.to_thread.run_sync(_is_8_bit, path):
            return FileResponse(path, media_type="image/png", headers=headers)
        asked = {"what": "picture", "path": str(path), "width_px": width_px}
        data = base64.b64decode((await self.worker.ask(asked))["picture"])
        kind = "image/jpeg" if data.startswith(b"\xff\xd8") else "image/png"
        return Response(data, media_type=kind, headers=headers)

    async def aim(self, request: Request) -> Response:
        """Answer `/api/aim`."""
        only(request.query_params)
        if self.live is not None:
            shown = self.live
            return self.answer(request, lambda: live_fields(shown))
        newest = await anyio.to_thread.run_sync(self.stored.newest)
        found = await self.stored.fields(newest)
        return self.answer(request, lambda: found)

    async def aim_picture(self, request: Request) -> Response:
        """Answer `/aim/main.jpg` and the others of the look last given."""
        name = request.path_params["name"]
        pictures = self.stored.pictures
        if self.live is not None:
            look, _ = self.live.now()
            pictures = {} if look is None else look.pictures
        if name not in pictures:
            raise HTTPException(404, "no such picture")
        kind = "image/png" if name.endswith(".png") else "image/jpeg"
        return Response(pictures[name], media_type=kind)


def _is_8_bit(path: Path) -> bool:
    """Whether a PNG is one that a browser shows as it was taken: 12 bits look nearly black."""
    with path.open("rb") as file:
        head = file.read(26)
    return head[:8] == b"\x89PNG\r\n\x1a\n" and head[24:25] == b"\x08"


def build_app(settings: Settings, live: Shown | None = None) -> Starlette:
    """The page of a site; with cameras that this process holds its aiming is live."""
    page = Page(settings, live)

    @asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        anyio.to_thread.current_default_thread_limiter().total_tokens = THREADS
        page.follower.start()
        try:
            yield
        finally:
            await page.worker.close()
            await page.analyses.close()
            await anyio.to_thread.run_sync(page.follower.stop)

    return Starlette(
        routes=_routes(page),
        middleware=[Middleware(Guard, viewers=settings.viewers, refuse=page.views.message)],
        exception_handlers=handlers(page.views),
        lifespan=lifespan,
    )


def site_app(page: Page) -> Starlette:
    """The page of one of many sites; whoever starts it guards it, and starts its follower."""
    return Starlette(routes=_routes(page), exception_handlers=handlers(page.views))


def handlers(views: Views) -> dict[Any, Any]:
    """What is said of what goes wrong."""

    async def wrong(request: Request, error: Exception) -> Response:
        return views.message(request.scope, 400, str(error))

    async def unreadable(request: Request, error: Exception) -> Response:
        return views.message(request.scope, 503, str(error))

    async def refused(request: Request, error: Exception) -> Response:
        status = error.status_code if isinstance(error, HTTPException) else 500
        text = error.detail if isinstance(error, HTTPException) else "internal error"
        text = "there is no such page" if text == "Not Found" else text
        return views.message(request.scope, status, text)

    return {
        AskedWronglyError: wrong,
        StoreError: unreadable,
        OSError: unreadable,
        WorkerError: unreadable,
        HTTPException: refused,
    }


def _routes(page: Page) -> list[Route]:
    def shown(name: str) -> Callable[[Request], Response]:
        return lambda _request: page.views.html(name)

    def slot_page(request: Request) -> Response:
        return page.views.html("slot", slot_utc=slot_text(asking.slot(request.path_params["slot"])))

    def calibration_page(request: Request) -> Response:
        return page.views.html("calibration", number=request.path_params["number"])

    def metrics(_request: Request) -> Response:
        return Response(page.metrics.text(), media_type=CONTENT_TYPE)

    routes = [
        Route("/", page.overview_page),
        Route("/metrics", metrics),
        *(Route(f"/{name}", shown(name)) for name in _PAGES),
        Route("/slot/{slot}", slot_page),
        Route("/calibrations/{number:int}", calibration_page),
        Route("/api/overview", page.overview),
        Route("/api/site", page.site),
        Route("/api/series", page.series),
        Route("/api/spans", page.spans),
        Route("/api/slot/{slot}", page.slot),
        Route("/api/slot/{slot}/targets", page.targets),
        Route("/api/days", page.days),
        Route("/api/gaps", page.listed(slots.gaps)),
        Route("/api/events", page.listed(slots.events)),
        Route("/api/calibrations", page.whole(slots.calibrations)),
        Route("/api/alarms", page.whole(page.alarms)),
        Route("/api/ledger", page.whole(slots.ledger)),
        Route("/api/datum", page.whole(slots.datum)),
        Route("/api/analysis", page.analysis),
        Route("/api/comparison", page.comparison),
        Route("/api/aim", page.aim),
        Route("/aim/{name}", page.aim_picture),
        Route("/frames/{slot}/{role}", page.frame),
        Route("/static/{path:path}", StaticFiles(HERE / "static").answer),
    ]
    return [route for route in routes if page.offers(route.path)]
