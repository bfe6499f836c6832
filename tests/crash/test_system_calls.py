"""Killed at, or refused, each system call of two slots: nothing is lost, and it goes on."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from subprocess import PIPE

import pytest

from daemon.store.sqlite import FILE_NAME
from tests.crash.interrupted import CALLS, SLOTS
from tests.crash.promises import Finished, Promises, broken, read_database
from tests.exhaustive import one_of
from tests.programs import Program, require_attached, require_strace

END = SLOTS[-1] + timedelta(seconds=200)

WRITING = ("mkdir", "rename", "unlink", "write", "pwrite64", "ftruncate", "fsync", "fdatasync")
"""Calls that change the disk; `openat`, which makes files, is another."""

INJECTIONS = {
    "killed": ("signal=KILL", (*WRITING, "openat")),
    "EIO": ("error=EIO", CALLS),
    "ENOSPC": ("error=ENOSPC", (*WRITING, "openat")),
}


@dataclass(frozen=True, slots=True)
class InterruptedRun:
    """What became of a daemon."""

    injection: str
    directory: Path
    exit: int
    """0 when it ended as asked, -9 when it was killed."""
    acknowledged: frozenset[int]
    """Numbers of slots."""
    calls: Counter[str]

    @property
    def state(self) -> Path:
        return self.directory / "state"


class Interrupter:
    """Starts daemons and has them interrupted."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._number = 0

    def run(self, injections: Iterable[str]) -> list[InterruptedRun]:
        injections = list(injections)
        names = [str(self._number + number) for number in range(len(injections))]
        self._number += len(names)
        orders = "".join(f"{name} {one}\n" for name, one in zip(names, injections, strict=True))
        complaints = self._root / "complaints"
        with Program(
            "tests.crash.interrupted", self._root, stdin=PIPE, stdout=PIPE, stderr=complaints
        ) as program:
            program.stdin.write(orders)
            program.stdin.close()
            answers = [json.loads(line) for line in program.stdout]
        assert program.returncode == 0, complaints.read_text()
        require_attached(answers[0]["strace"])
        return [
            InterruptedRun(
                one,
                self._root / name,
                answer["exit"],
                frozenset(answer["acknowledged"]),
                Counter(answer["calls"]),
            )
            for name, one, answer in zip(names, injections, answers, strict=True)
        ]


@pytest.fixture(scope="module")
def interrupter(scratch: Path) -> Interrupter:
    require_strace()
    root = scratch / "interrupted"
    root.mkdir()
    return Interrupter(root)


@pytest.fixture(scope="module")
def undisturbed(interrupter: Interrupter) -> InterruptedRun:
    """A run that nothing happens to."""
    (run,) = interrupter.run(["-"])
    assert run.acknowledged == frozenset(range(len(SLOTS)))
    return run


@pytest.fixture(scope="module")
def reference(undisturbed: InterruptedRun) -> Finished:
    return read_database(undisturbed.state / FILE_NAME)


def calls_of(undisturbed: InterruptedRun, how: str, calls: Sequence[str]) -> list[str]:
    """An injection at calls of each of these kinds that the undisturbed run made."""
    return [
        f"{call}:{how}:when={number}"
        for call in calls
        for number in range(1, undisturbed.calls[call] + 1, one_of(16))
    ]


def frames_of(slots: Iterable[int], undisturbed: InterruptedRun) -> dict[str, bytes]:
    """The images of slots, as every run takes them."""
    files = {}
    for number in slots:
        for path in undisturbed.state.glob(f"frames/{SLOTS[number]:%Y/%m/%d/%H%M%S}_*.png"):
            files[str(path.relative_to(undisturbed.state))] = path.read_bytes()
    return files


def test_killed_at_each_call_nothing_acknowledged_is_lost(
    interrupter: Interrupter,
    undisturbed: InterruptedRun,
    reference: Finished,
    tally: Callable[[str], None],
) -> None:
    found = []
    runs = interrupter.run(calls_of(undisturbed, *INJECTIONS["killed"]))
    for run in runs:
        assert run.exit == -9, run
        promised = Promises(
            first_slot_utc=SLOTS[0],
            rows=frozenset(SLOTS[number] for number in run.acknowledged),
            files=frames_of(run.acknowledged, undisturbed),
            absence=frozenset({"power_loss", "stopped"}),
        )
        why = broken(run.state, promised, reference, END, twice=False)
        found += [f"{run.injection}: {why}"] if why else []
    tally(f"SIGKILL at {len(runs)} system calls of two slots: {len(found)} broke a promise")
    assert found == []


@pytest.mark.parametrize("error", ["EIO", "ENOSPC"])
def test_refused_each_call_it_goes_on_and_accounts_for_every_slot(
    interrupter: Interrupter, undisturbed: InterruptedRun, error: str, tally: Callable[[str], None]
) -> None:
    found = []
    runs = interrupter.run(calls_of(undisturbed, *INJECTIONS[error]))
    for run in runs:
        why = went_on(run)
        why += broken(run.state, *promised_by(run, undisturbed), END, twice=False)
        found += [f"{run.injection}: {why}"] if why else []
    tally(f"{error} at {len(runs)} system calls of two slots: {len(found)} broke a promise")
    assert found == []


def went_on(run: InterruptedRun) -> list[str]:
    """A call that fails once costs one slot at most, and never the daemon."""
    if run.exit != 0:
        return [f"it ended with {run.exit}"]
    lost = len(SLOTS) - len(run.acknowledged)
    return [f"{lost} slots have no row"] if lost > 1 else []


def promised_by(run: InterruptedRun, undisturbed: InterruptedRun) -> tuple[Promises, Finished]:
    """What a run that came to its end had promised; its rows name the frames that it kept."""
    left = read_database(run.state / FILE_NAME)
    slots = frozenset(SLOTS[number] for number in run.acknowledged)
    kept = [number for number in run.acknowledged if names_frames(left, number)]
    promised = Promises(
        first_slot_utc=SLOTS[0],
        rows=slots,
        files=frames_of(kept, undisturbed),
        absence=frozenset({"power_loss", "stopped"}),
    )
    return promised, left


def names_frames(left: Finished, number: int) -> bool:
    row = left.rows.get(SLOTS[number], ())
    return any(isinstance(cell, str) and cell.endswith("_main.png") for cell in row)
