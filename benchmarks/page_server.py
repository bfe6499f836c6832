"""dcam-web beside a record, as a program of its own."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]


@contextmanager
def serving(config: Path, state: Path | None) -> Iterator[str]:
    """Run `dcam-web` on a free port while the block runs; gives its address.

    Without a state directory it is that of the config, or all sites of a central database.
    """
    command = [sys.executable, "-m", "daemon.web_main", "--port", "0"]
    where = ["--config", str(config), *([] if state is None else ["--state", str(state)])]
    with subprocess.Popen(
        [*command, *where], cwd=ROOT, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield _address(process)
        finally:
            process.terminate()


def _address(process: subprocess.Popen[str]) -> str:
    """What it says when it listens. Raises RuntimeError with its own words when it does not."""
    said = []
    for line in process.stderr or ():
        said.append(line)
        if found := re.search(r"(http://\S+?)/ shows (the record|all sites)", line):
            return found[1]
    msg = f"dcam-web does not serve: {''.join(said)}"
    raise RuntimeError(msg)
