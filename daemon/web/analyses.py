"""Answers that take seconds: worked out by a process of its own, and kept for a while."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Mapping
from datetime import datetime
from typing import Any

import orjson
from starlette.datastructures import QueryParams

from daemon.web import asking
from daemon.web.asking import AskedWronglyError, only
from daemon.web.settings import Settings
from daemon.web.worker import Worker

DEADLINE_S = 300.0
"""Ten years of minutes on a small computer."""
KEPT_S = 600.0
"""A minute's row changes little of what weeks say."""
MOST_KEPT = 12


class Analyses:
    """What spans say, and a reference beside them."""

    def __init__(self, settings: Settings) -> None:
        self._worker = Worker(
            "daemon.web.analyst",
            *(settings.site.config_path, settings.state),
            does="analysis",
            deadline_s=DEADLINE_S,
        )
        self._kept: OrderedDict[bytes, tuple[float, dict[str, Any]]] = OrderedDict()
        self._turn = asyncio.Lock()

    async def answer(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """The answer, kept or worked out now. Raises WorkerError, AskedWronglyError."""
        key = orjson.dumps(asked)
        if (found := self._fresh(key)) is not None:
            return found
        async with self._turn:  # whoever asked the same meanwhile has it
            if (found := self._fresh(key)) is not None:
                return found
            said = {"schema": 1, **asked, **await self._worker.ask(asked)}
            self._kept[key] = time.monotonic(), said
            while len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)
            return said

    def _fresh(self, key: bytes) -> dict[str, Any] | None:
        made_s, said = self._kept.get(key, (-KEPT_S, None))
        return said if time.monotonic() - made_s < KEPT_S else None

    def end(self) -> None:
        """As `Worker.end`."""
        self._worker.end()

    async def close(self) -> None:
        """End the process."""
        await self._worker.close()


def analysis_asked(query: QueryParams, span: tuple[datetime, datetime]) -> dict[str, Any]:
    """What `/api/analysis` is asked for. Raises AskedWronglyError."""
    only(query, "point", "axis", "loaded", "since", "until")
    axis = query.get("axis", "y")
    if axis not in {"x", "y"}:
        msg = "axis: x or y"
        raise AskedWronglyError(msg)
    loaded = query.get("loaded")
    return {
        "what": "analysis",
        "point": query.get("point", "main"),
        "axis": axis,
        "loaded": asking.moment(loaded, "loaded").isoformat() if loaded else None,
        **span_fields(span),
    }


def span_fields(span: tuple[datetime, datetime]) -> dict[str, str]:
    """A span as the worker reads it."""
    return {name: when.isoformat() for name, when in zip(("since", "until"), span, strict=True)}
