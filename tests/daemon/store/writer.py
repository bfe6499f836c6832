"""A program that stores slots, acknowledges each, and is killed at a given step.

`writer.py STATE` runs once, undisturbed. `writer.py STATE --kill` runs in STATE/1, STATE/2, ...,
each run in a process of its own that SIGKILL ends just before its 1st, 2nd, ... step, until a run
comes through. A step is a sync, a rename, an SQL statement, a commit or an acknowledgement. Each
run finds an empty database there: that its making may be cut off anywhere is shown in tests/crash.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from sqlalchemy import Engine, event

from daemon.store.database import open_store
from daemon.store.frames.archive import FrameArchive
from daemon.store.records import GapCause
from tests import made_database
from tests.daemon.store.examples import PERIOD_S, full_record, pair, slot

SLOTS = 2


def acknowledge(state: Path, number: int) -> None:
    """Tell the parent, in one write, that a slot is safe."""
    os.write(1, f"{state.name} {number}\n".encode())


def run(state: Path, tell: Callable[[Path, int], None] = acknowledge) -> None:
    """Frames, row, acknowledgement, slot by slot, out of a gap that shrinks with each."""
    archive = FrameArchive(state)
    with open_store(state) as store:
        store.record_gap(slot(0), slot(SLOTS - 1), GapCause.CRASH, period_s=PERIOD_S)
        for number in range(SLOTS):
            archive.store(slot(number), pair(number))
            store.add_measurement(full_record(slot(number)))
            tell(state, number)


def die_at(last_step: int) -> Callable[[], None]:
    """Count steps; the given one is never done."""
    done = 0

    def step(*_: Any, **__: Any) -> None:
        nonlocal done
        done += 1
        if done == last_step:
            os.kill(os.getpid(), signal.SIGKILL)

    return step


def counted(step: Callable[[], None], function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that is a step."""

    def wrapper(*arguments: Any, **options: Any) -> Any:
        step()
        return function(*arguments, **options)

    return wrapper


def killed_run(state: Path, last_step: int) -> None:
    """Run until the given step."""
    step = die_at(last_step)
    os.fsync = counted(step, os.fsync)
    os.replace = counted(step, os.replace)
    event.listen(Engine, "before_cursor_execute", step)
    event.listen(Engine, "commit", step)
    run(state, counted(step, acknowledge))


def main() -> None:
    """See above."""
    state = Path(sys.argv[1])
    if "--kill" not in sys.argv:
        run(state)
        return
    made_database.share()
    with TemporaryDirectory() as first:  # before there are children
        open_store(Path(first)).close()
    last_step, status = 0, 1
    while status != 0:
        last_step += 1
        child = os.fork()
        if child == 0:
            open_store(state / str(last_step)).close()
            killed_run(state / str(last_step), last_step)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        if status not in {0, signal.SIGKILL}:
            sys.exit(f"step {last_step}: ended by itself with status {status}")


if __name__ == "__main__":
    main()
