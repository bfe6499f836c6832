"""`[log]`: how the log is written."""

from __future__ import annotations

from typing import Literal

from daemon.config.section import Section


class LogSection(Section):
    """`[log]`."""

    format: Literal["keyvalue", "json"] = "keyvalue"
    level: Literal["debug", "info", "warning", "error"] = "info"
