"""Runs on the lossy file system, and every state of the disk that a cut could leave of them."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

from daemon.store.database import Store
from daemon.store.sqlite import FILE_NAME
from tests.crash.disk import Cut, Disk, Operation, Tree, put
from tests.crash.lossy_fs import LossyMount
from tests.crash.promises import Finished, Promises, broken, read_database
from tests.crash.station import heard
from tests.exhaustive import one_of

STATE = "state"
"""The state directory of every run, within the run's own directory."""
BEGIN = "begin"
"""The mark before which everything is safe; other marks are numbers of promises."""

ABSENCE = timedelta(seconds=200)
ONE_OF = one_of(20)
"""Of so many states in a row that are alike, one is tried."""
AGAIN = 4
"""Each so many of those are recovered a second time."""

_numbers = itertools.count(1)


@dataclass(frozen=True, slots=True)
class Recording:
    """A run: what it did to the disk, and what it had promised when."""

    directory: str
    """Of the run, on the file system."""
    log: Sequence[Operation]
    promises: Sequence[Promises]
    finished: Finished
    end_utc: datetime


@dataclass(frozen=True, slots=True)
class CutState:
    """What a cut leaves, and what had been promised by then."""

    tree: Tree
    promised: Promises
    after: int
    """Operations done before it."""
    cut: Cut


class Scribe:
    """Writes down the promises of a run in progress, in order with what it does to the disk."""

    def __init__(self, mount: LossyMount, directory: Path, before: Promises) -> None:
        self.directory = directory
        self.state = directory / STATE
        self.promises = [before]
        self.clock_is_wrong = False
        """Slots that are acknowledged will be others."""
        self._mount = mount

    def tell(self, **changes: Any) -> None:
        """From now on this is promised too."""
        self.promises.append(replace(self.promises[-1], **changes))
        self._mount.mark(str(len(self.promises) - 1))

    def slot_done(self, slot_utc: datetime) -> None:
        """A row has been acknowledged, and with it its frames."""
        last = self.promises[-1]
        images = self.state.rglob(f"frames/{slot_utc:%Y/%m/%d/%H%M%S}_*.png")
        files = {str(path.relative_to(self.state)): path.read_bytes() for path in images}
        if self.clock_is_wrong:
            self.tell(pictures=last.pictures | set(files.values()))
            return
        self.tell(rows=last.rows | {slot_utc}, files={**last.files, **files})

    def settled(self, store: Store) -> None:
        """Gaps, events and the calibration in use are as calls that have returned left them."""
        active = store.active_calibration()
        gaps = {
            gap.first_slot_utc + number * timedelta(seconds=gap.period_s): gap.cause.value
            for gap in store.gaps()
            for number in range(gap.slots)
        }
        kinds = frozenset((event.kind, event.detail) for event in store.events())
        self.tell(gaps=gaps, events=kinds, calibration_id=(active and active.id) or 0)


class Run(Protocol):
    """What is recorded; gives the time of its end."""

    def __call__(self, scribe: Scribe) -> datetime:
        """Run on the scribe's state directory."""


def record(
    mount: LossyMount, run: Run, before: Tree | None = None, promised: Promises | None = None
) -> Recording:
    """Let a run begin on a disk that holds something, with its promises, or nothing."""
    mount.take()
    directory = mount.directory / str(next(_numbers))
    directory.mkdir()
    put(before or {}, directory)
    mount.mark(BEGIN)
    scribe = Scribe(mount, directory, promised or Promises())
    with heard(scribe.slot_done):
        end_utc = run(scribe)
    log = mount.take()
    finished = read_database(scribe.state / FILE_NAME)
    return Recording(directory.name, log, scribe.promises, finished, end_utc)


def cut_states(recording: Recording, cuts: Sequence[Cut] = tuple(Cut)) -> Iterator[CutState]:
    """The states that the power could be cut in, in order, each but once with one promise.

    What is safe is looked at after every operation; what is there by chance, after every tenth. Of
    the states of one kind of cut below one promise, the first is chosen, and some of the others.
    """
    disk, promised, begun = Disk(), recording.promises[0], False
    seen: set[tuple[int, int]] = set()
    alike: Counter[tuple[Cut, int]] = Counter()
    for number, operation in enumerate(recording.log):
        disk.do(operation)
        if operation.kind == "mark" and operation.name == BEGIN:
            disk.sync_all()
            begun = True
        elif operation.kind == "mark":
            promised = recording.promises[int(operation.name)]
        its_turn = {Cut.KILLED: number % 10 == 0, Cut.TORN: number % 10 == 5}
        for cut in cuts if begun else ():
            if its_turn.get(cut, True):
                tree = _within(disk.left_by(cut, number), f"{recording.directory}/")
                key = hash(tuple(tree.items())), id(promised)
                if key not in seen:
                    kind = cut, id(promised)
                    if alike[kind] % ONE_OF == 0:
                        yield CutState(tree, promised, number, cut)
                    alike[kind] += 1
                seen.add(key)


def judge(
    recording: Recording, states: Iterable[CutState], scratch: Path
) -> Iterator[tuple[CutState, list[str]]]:
    """Put each state on another disk, come back on it a while later, and tell what is broken."""
    now_utc = recording.end_utc + ABSENCE
    for number, state in enumerate(states):
        with TemporaryDirectory(dir=scratch) as directory:
            put(state.tree, Path(directory))
            place, finished = Path(directory) / STATE, recording.finished
            twice = number % AGAIN == 0
            yield state, broken(place, state.promised, finished, now_utc, twice=twice)


def _within(tree: Tree, directory: str) -> Tree:
    return {
        path.removeprefix(directory): content
        for path, content in tree.items()
        if path.startswith(directory)
    }
