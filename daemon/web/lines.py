"""A worker's side: one JSON object a line in, one a line out, until nobody asks any more."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from typing import Any

from core.errors import CoreError
from daemon.error_report import lines_of
from daemon.errors import DcamError
from drivers.errors import DriverError


def answer_lines(answer: Callable[[Mapping[str, Any]], dict[str, Any]]) -> None:
    """Answer each line of standard input; what cannot be done is one line, as `error`."""
    os.nice(10)  # a slot goes first
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer
    for line in sys.stdin:
        try:
            said = answer(json.loads(line))
        except (DcamError, DriverError, CoreError, OSError) as error:
            said = {"error": "; ".join(lines_of(error))}
        print(json.dumps(said), file=answers, flush=True)
