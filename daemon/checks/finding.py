"""One thing looked at: how it is, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from daemon.error_report import exit_code_of, lines_of
from daemon.errors import ExitCode


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing looked at."""

    name: str
    state: Literal["ok", "warning", "error"]
    text: str
    """What is, and what to do about it."""
    exit_code: ExitCode = ExitCode.DONE


def failed(name: str, error: Exception) -> Finding:
    """A finding that an error makes."""
    return Finding(name, "error", "; ".join(lines_of(error)), exit_code_of(error))


def unless(cured: bool, name: str, text: str, cure: str) -> Finding:
    """Ok if it is `cured`, else a warning with the cure."""
    return Finding(name, "ok", text) if cured else Finding(name, "warning", f"{text}: {cure}")
