"""Whether the reports of finished months can be written."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path

from daemon.checks.finding import Finding
from daemon.config.report import DIRECTORY, ReportSection


def check_report(settings: ReportSection, state: Path) -> Iterator[Finding]:
    """Look at `[report]`: the directory, and the library that draws."""
    if not settings.monthly:
        yield Finding("report", "ok", "no monthly reports: [report] monthly = false")
        return
    directory = state / DIRECTORY
    if directory.exists() and not os.access(directory, os.W_OK | os.X_OK):
        text = f"{directory} cannot be written by this user: chown -R dcam:dcam {directory}"
        yield Finding("report", "warning", text)
    elif importlib.util.find_spec("matplotlib") is None:
        text = "monthly reports have no figure: install dcam's extra plot"
        yield Finding("report", "warning", text)
    else:
        yield Finding("report", "ok", f"each finished month in {directory}{_last(directory)}")


def _last(directory: Path) -> str:
    names = sorted(path.stem for path in directory.glob("????-??.pdf"))
    return f", the last {names[-1]}" if names else ", none yet"
