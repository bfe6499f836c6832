"""The log: one line an event on stderr, key=value for the journal or JSON for programs."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Mapping, MutableMapping
from typing import Any, Literal, TextIO

import structlog

from daemon.text import visible

LogFormat = Literal["keyvalue", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]

_JOURNAL_PRIORITY = {"debug": 7, "info": 6, "warning": 4, "error": 3, "critical": 2}


def configure_log(
    log_format: LogFormat = "keyvalue",
    level: LogLevel = "info",
    stream: TextIO | None = None,
    environ: Mapping[str, str] = os.environ,
) -> None:
    """Send our loggers (`dcam.<layer>`) and those of libraries to stderr, never to stdout."""
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=_before_rendering(),
            processors=[
                structlog.stdlib.ProcessorFormatter.remove_processors_meta,
                structlog.processors.format_exc_info,
                _Renderer(log_format, in_journal="JOURNAL_STREAM" in environ),
            ],
        )
    )
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.WARNING)
    logging.getLogger("dcam").setLevel(level.upper())
    structlog.configure(
        processors=[
            structlog.stdlib.filter_by_level,
            *_before_rendering(),
            structlog.stdlib.ProcessorFormatter.wrap_for_formatter,
        ],
        wrapper_class=structlog.stdlib.BoundLogger,
        logger_factory=structlog.stdlib.LoggerFactory(),
        cache_logger_on_first_use=False,
    )


def _before_rendering() -> list[structlog.typing.Processor]:
    return [
        structlog.stdlib.add_logger_name,
        structlog.stdlib.add_log_level,
        structlog.stdlib.ExtraAdder(),
        structlog.processors.TimeStamper(fmt="iso", utc=True, key="time"),
    ]


class _Renderer:
    """Writes an event as text; before journald with the priority that it files the line under."""

    def __init__(self, log_format: LogFormat, *, in_journal: bool) -> None:
        first = ["time", "level", "logger", "event"]
        self._render: structlog.typing.Processor = (
            structlog.processors.JSONRenderer(default=str)
            if log_format == "json"
            else structlog.processors.LogfmtRenderer(
                key_order=first, drop_missing=True, bool_as_flag=False
            )
        )
        self._in_journal = in_journal

    def __call__(self, logger: Any, method: str, event: MutableMapping[str, Any]) -> str:
        priority = _JOURNAL_PRIORITY.get(event.get("level", ""), 6)
        text = visible(str(self._render(logger, method, event)))
        return f"<{priority}>{text}" if self._in_journal else text
