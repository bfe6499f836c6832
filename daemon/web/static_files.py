"""Scripts and styles, read once: a dozen of them stand before the first figure."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from daemon.web.answers import LEAST_TO_PACK, packed

_KINDS = {".js": "text/javascript", ".css": "text/css", ".json": "application/json"}
"""The machine's own list may say another thing, and a browser then refuses a script."""
_LEVEL = 9
"""Of gzip: done once, and what crosses a slow tunnel is smallest."""


@dataclass(frozen=True, slots=True)
class _File:
    body: bytes
    packed: bytes | None
    media_type: str
    tag: str


class StaticFiles:
    """All files of a directory, from memory; nothing else can be named."""

    def __init__(self, directory: Path) -> None:
        self._files = {
            path.relative_to(directory).as_posix(): _read(path)
            for path in directory.rglob("*")
            if path.is_file()
        }

    async def answer(self, request: Request) -> Response:
        """Answer `/static/...`: 304 where the browser has it."""
        file = self._files.get(request.path_params["path"])
        if file is None:
            raise HTTPException(404)
        headers = {"etag": file.tag, "cache-control": "no-cache", "vary": "accept-encoding"}
        if file.tag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        if file.packed is None or "gzip" not in request.headers.get("accept-encoding", ""):
            return Response(file.body, media_type=file.media_type, headers=headers)
        headers["content-encoding"] = "gzip"
        return Response(file.packed, media_type=file.media_type, headers=headers)


def _read(path: Path) -> _File:
    body = path.read_bytes()
    kind = _KINDS.get(path.suffix, "text/plain")
    tag = f'W/"{hashlib.blake2b(body, digest_size=12).hexdigest()}"'
    return _File(body, packed(body, _LEVEL) if len(body) >= LEAST_TO_PACK else None, kind, tag)
