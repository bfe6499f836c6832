"""A worker's side: one JSON object a line in, one a line out, until nobody asks any more."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from typing import Any

from core.errors import CoreError
from daemon.error_report import lines_of
from daemon.errors import DcamError, UsageError
from drivers.errors import DriverError


def answer_lines(answer: Callable[[Mapping[str, Any]], dict[str, Any]]) -> None:
    """Answer each line of standard input; what is asked wrongly or cannot be done is one line."""
    os.nice(10)  # a slot goes first
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer
    for line in sys.stdin:
        try:
            said = answer(json.loads(line))
        except UsageError as error:  # a name of the page has no dashes
            said = {"asked_wrongly": "; ".join(lines_of(error)).removeprefix("--")}
        except (DcamError, DriverError, CoreError, OSError) as error:
            said = {"error": "; ".join(lines_of(error))}
        print(json.dumps(said), file=answers, flush=True)
