"""Whether the reports of finished months can be written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from daemon.checks.finding import Finding
from daemon.config.report import DIRECTORY, ReportSection
from drivers.libraries import missing_library


def check_report(settings: ReportSection, state: Path) -> Iterator[Finding]:
    """Look at `[report]`: the directory, and the library that draws."""
    if not settings.monthly:
        yield Finding("report", "ok", "no monthly reports: [report] monthly = false")
        return
    directory = state / DIRECTORY
    if directory.exists() and not os.access(directory, os.W_OK | os.X_OK):
        text = f"{directory} cannot be written by this user: chown -R dcam:dcam {directory}"
        yield Finding("report", "warning", text)
    elif lack := missing_library("matplotlib", "figure"):
        yield Finding("report", "warning", f"monthly reports: {lack}")
    else:
        yield Finding("report", "ok", f"each finished month in {directory}{_last(directory)}")


def _last(directory: Path) -> str:
    names = sorted(path.stem for path in directory.glob("????-??.pdf"))
    return f", the last {names[-1]}" if names else ", none yet"
