"""`[report]`: what a report for the client says of people, and what is written every month."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from daemon.config.section import Directory, Section

DIRECTORY = "reports"
"""Of the months' reports, in the state directory."""

Line = Annotated[str, Field(max_length=500)]


class ReportSection(Section):
    """`[report]`."""

    client: Line = ""
    contact: Line = ""
    traceability: Line = ""
    reference: Directory | None = None
    monthly: bool = True
    months_kept: int = Field(default=24, ge=1, le=1200)
