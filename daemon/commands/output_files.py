"""Files that commands write: whole and durable, or not at all."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from daemon.durable import replacing


@contextmanager
def opened_table(path: Path | None) -> Iterator[TextIO]:
    """Open a file to write a table to, or stdout for None.

    The file appears, or replaces an older one, complete and durable, or not at all; devices and
    pipes are written to as they are. Raises OSError.
    """
    if path is None:
        yield sys.stdout
        sys.stdout.flush()
    elif path.exists() and not path.is_file():
        with path.open("w", encoding="utf-8", newline="") as file:
            yield file
    else:
        with (
            new_file(path) as temporary,
            temporary.open("w", encoding="utf-8", newline="") as file,
        ):
            yield file


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Give a name to write to; the file appears complete and durable, or not at all.

    Raises OSError.
    """
    path = path.resolve()  # a link is followed, not replaced
    with replacing(path) as temporary:
        try:
            temporary.touch()
        except OSError as error:
            error.filename = str(path.parent)  # nobody knows the temporary name
            raise
        yield temporary
