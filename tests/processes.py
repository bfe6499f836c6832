"""Other processes, as /proc shows them: each may end at any time, also while it is looked at."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

Ended = (FileNotFoundError, ProcessLookupError)
"""What the kernel says of a process, a thread or an open file that is no more."""


def read_of(pid: int, name: str) -> bytes:
    """A file of the process in /proc; empty when the process has ended."""
    with suppress(*Ended):
        return Path(f"/proc/{pid}/{name}").read_bytes()
    return b""


def is_alive(pid: int) -> bool:
    """Whether it runs; a dead one that nobody has waited for does not."""
    state = read_of(pid, "stat").rpartition(b")")[2].split()
    return bool(state) and state[0] != b"Z"


def descendants(pid: int) -> list[int]:
    """The processes that a process has started, those that they have started, and so on."""
    tasks = _names_in(pid, "task")
    pids = [int(child) for task in tasks for child in read_of(pid, f"task/{task}/children").split()]
    return pids + [further for child in pids for further in descendants(child)]


def open_files(pid: int) -> list[str]:
    """Where the open files of a process lead to; none when it has ended."""
    found = []
    for number in _names_in(pid, "fd"):
        with suppress(*Ended):
            found.append(str(Path(f"/proc/{pid}/fd/{number}").readlink()))
    return found


def _names_in(pid: int, directory: str) -> list[str]:
    with suppress(*Ended):
        return [path.name for path in Path(f"/proc/{pid}/{directory}").iterdir()]
    return []
