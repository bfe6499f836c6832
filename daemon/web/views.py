"""The page's HTML: templates with texts in the page's language, below one place of the server."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from starlette.datastructures import Headers
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.types import Scope

from daemon.version import VERSION

if TYPE_CHECKING:
    from jinja2 import Environment

HERE = Path(__file__).parent
SITE_PAGES = {
    "overview": "/",
    "days": "/days",
    "analysis": "/analysis",
    "events": "/events",
    "calibrations": "/calibrations",
    "aim": "/aim",
}
"""Where a site's pages are, below its own place."""


@dataclass(frozen=True, slots=True)
class Views:
    """Makes pages of a site, or of all sites."""

    site: str
    timezone: str
    language: str
    texts: Mapping[str, str]
    root: str = ""
    """Before all addresses but those of /static/."""
    pages: Mapping[str, str] | None = None
    """What can be chosen above, by the addresses below `root`; None: a site's."""
    has_site_time: bool = True
    """Whether there is one site, whose own time people may want."""

    def html(self, page: str, status: int = 200, **context: object) -> HTMLResponse:
        """A page."""
        pages = SITE_PAGES if self.pages is None else self.pages
        template = _templates().get_template(f"{page}.html")
        text = template.render(
            page=page,
            site=self.site,
            t=self.texts,
            language=self.language,
            timezone=self.timezone,
            version=VERSION,
            icon=_ICON,
            root=self.root,
            pages=pages,
            has_site_time=self.has_site_time,
            **context,
        )
        return HTMLResponse(text, status)

    def message(self, scope: Scope, status: int, text: str) -> Response:
        """Say what is wrong, to a browser or to a program."""
        path = str(scope["path"]).removeprefix(str(scope.get("root_path", "")))
        accepted = Headers(scope=scope).get("accept", "")
        if path.startswith(("/api/", "/frames/")) or "text/html" not in accepted:
            return JSONResponse({"error": text}, status)
        titles = {202: "title_fetching", 401: "title_login", 404: "title_not_found"}
        title = self.texts.get(titles.get(status, ""), f"{status}")
        return self.html("message", status, title=title, text=text, login=status == 401)


_ICON = (
    "data:image/svg+xml;base64,"
    + base64.b64encode((HERE / "templates/icon.svg").read_bytes()).decode()
)  # as a file a browser asks for it again at each change of the address


@cache
def _templates() -> Environment:
    """All templates; loaded with the first page that somebody opens, as they take 2 MB."""
    from jinja2 import Environment, FileSystemLoader

    return Environment(
        loader=FileSystemLoader(HERE / "templates"), autoescape=True, auto_reload=False
    )


def texts_of(language: str) -> dict[str, str]:
    """All texts of the page: English where a language has none."""
    texts: dict[str, str] = {}
    for name in ("en", language):
        path = HERE / "static" / "strings" / f"{name}.json"
        if path.is_file():
            texts |= json.loads(path.read_text(encoding="utf-8"))
    return texts
