"""A daemon that is interrupted at one system call of its slots, by strace; again and again.

A program: it reads lines of `NAME INJECTION` (as strace's `inject=`; `-` only counts) and answers
each with a line of JSON. For each it forks: the child runs the daemon in ROOT/NAME, its first slot
in peace, and the others with strace attached.
"""

from __future__ import annotations

import json
import logging
import mmap
import os
import re
import select
import shutil
import subprocess
import sys
from collections import Counter
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

from daemon.errors import StoreError
from daemon.log import configure_log
from daemon.slots.recovery import mark_stop
from daemon.store.database import open_store
from tests import compiled_sql
from tests.crash.station import PERIOD_S, daemon, measured_by_eye

START = datetime(2026, 3, 1, 23, 57, 30, tzinfo=UTC)
SLOTS = [START + timedelta(seconds=30 + PERIOD_S * number) for number in range(3)]
"""The first is undisturbed; the third begins a new day, and its directory."""

CALLS = (  # those that reach the disk: no locks, no seeking
    *("openat", "mkdir", "rename", "unlink", "write", "pwrite64", "ftruncate"),
    *("fsync", "fdatasync", "read", "pread64", "newfstatat", "getdents64"),
)

TEMPLATE = "template"
"""An empty database's directory."""


class _Acknowledgements(logging.Handler):
    """Notes slots in memory that the parent shares: without a system call of its own."""

    def __init__(self, shared: mmap.mmap) -> None:
        super().__init__()
        self._shared = shared

    def emit(self, record: logging.LogRecord) -> None:
        event = record.msg if isinstance(record.msg, dict) else {}
        if event.get("event") == "slot_done":
            self._shared[SLOTS.index(datetime.fromisoformat(event["slot"]))] = 1


def live(state: Path, shared: mmap.mmap, ready: int, go: int) -> None:
    """One life of the daemon; before the second slot it says `ready` and waits for `go`."""
    with (state.parent / "log").open("w") as log, measured_by_eye():
        configure_log(stream=log)
        logging.getLogger().addHandler(_Acknowledgements(shared))
        with daemon(state, START, "boot-1") as (station, runner):
            runner.run(1)
            os.write(ready, b"1")
            select.select([go], [], [])  # no call that is interrupted
            assert runner.run(len(SLOTS) - 1) == len(SLOTS) - 1
            with suppress(StoreError):  # a stop that cannot be noted is a crash to the next start
                mark_stop(station.store, station.clock.now_utc())


def rehearse(root: Path) -> None:
    """Live once here, so that the children find everything imported, and tables made."""
    open_store(root / TEMPLATE).close()
    reader, writer = os.pipe()
    os.write(writer, b"1")
    with TemporaryDirectory(dir=root) as directory:
        shutil.copytree(root / TEMPLATE, Path(directory) / "state")
        live(Path(directory) / "state", mmap.mmap(-1, len(SLOTS)), writer, reader)
    logging.getLogger().handlers.clear()
    os.close(reader)
    os.close(writer)


def run(directory: Path, injection: str) -> dict[str, object]:
    """Let a daemon live, be interrupted, and tell how it ended."""
    shutil.copytree(directory.with_name(TEMPLATE), directory / "state")
    shared = mmap.mmap(-1, len(SLOTS))
    (was_ready, ready), (go, let_go) = os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            live(directory / "state", shared, ready, go)
            code = 0
        finally:
            os._exit(code)
    os.read(was_ready, 1)
    trace = directory / "trace"
    command = ["strace", "-o", str(trace), "-e", f"trace={','.join(CALLS)}", "-p", str(child)]
    command += [] if injection == "-" else ["-e", f"inject={injection}"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as tracer:
        said = tracer.stderr.readline()
        if "attached" not in said:
            os.kill(child, 9)
        os.write(let_go, b"1")
        _, status = os.waitpid(child, 0)
    for end in (was_ready, ready, go, let_go):
        os.close(end)
    text = trace.read_text() if trace.exists() else ""
    return {
        "strace": said.strip(),
        "exit": os.waitstatus_to_exitcode(status),
        "acknowledged": [number for number, done in enumerate(shared[:]) if done],
        "calls": Counter(re.findall(r"^(\w+)\(", text, re.MULTILINE)),
    }


def main() -> None:
    """See above."""
    root = Path(sys.argv[1])
    compiled_sql.share()
    rehearse(root)
    for line in sys.stdin:
        name, injection = line.split()
        sys.stdout.write(json.dumps(run(root / name, injection)) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
