"""JSON as bytes: packed where it helps, with a tag that tells a browser whether it has changed."""

from __future__ import annotations

import hashlib
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import orjson
from starlette.requests import Request
from starlette.responses import Response

LEAST_TO_PACK = 1024
KEPT_BYTES = 8_000_000
"""Answers that stand ready for those who ask the same."""
_GZIP = 16 + zlib.MAX_WBITS


class Answers:
    """Answers made lately, by what was asked and of which state of the record."""

    def __init__(self) -> None:
        self._kept: OrderedDict[object, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def json(self, key: object, make: Callable[[], Any]) -> bytes:
        """An answer as bytes: kept, or made now. Whoever asks meanwhile waits."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
            body = self._kept[key] = as_json(make())
            while sum(map(len, self._kept.values())) > KEPT_BYTES:
                self._kept.popitem(last=False)
            return body


def as_json(content: Any) -> bytes:
    """Arrays as lists, times in ISO 8601, None for what is no number."""
    how = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS | orjson.OPT_UTC_Z
    return orjson.dumps(content, option=how, default=_plain)


def _plain(value: Any) -> Any:
    """What JSON has no word for: whole texts, as of paths."""
    return str(value)


def packed(body: bytes, level: int) -> bytes:
    """Bytes as gzip."""
    packer = zlib.compressobj(level, zlib.DEFLATED, _GZIP)
    return packer.compress(body) + packer.flush()


def respond(request: Request, body: bytes) -> Response:
    """The answer of a request: 304 where the browser has it, packed where it takes that."""
    tag = f'W/"{hashlib.blake2b(body, digest_size=12).hexdigest()}"'
    headers = {"etag": tag, "cache-control": "no-cache", "vary": "accept-encoding"}
    if tag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    if len(body) >= LEAST_TO_PACK and "gzip" in request.headers.get("accept-encoding", ""):
        body = packed(body, 1)
        headers["content-encoding"] = "gzip"
    return Response(body, media_type="application/json", headers=headers)
