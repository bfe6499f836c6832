"""kill -9 at every step: what was acknowledged is there, and what is there is whole."""

from __future__ import annotations

import re
import shutil
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from daemon.store.database import open_store
from daemon.store.frames.archive import FrameArchive
from drivers.frameset import read_frame_set
from tests.daemon.store.examples import PERIOD_S, full_record, pair, slot
from tests.daemon.store.writer import SLOTS
from tests.programs import ran, traced

WRITER = "tests.daemon.store.writer"


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, list[int]]:
    """The state directory of each killed run, with the slots that it acknowledged."""
    states = tmp_path_factory.mktemp("killed")
    result = ran(WRITER, states, "--kill")
    assert result.returncode == 0, result.stderr
    acknowledged = defaultdict(list)
    for line in result.stdout.splitlines():
        name, number = line.split()
        acknowledged[name].append(int(number))
    return {state: acknowledged[state.name] for state in states.iterdir()}


def test_there_were_kills_at_every_stage(killed: dict[Path, list[int]]) -> None:
    assert len(killed) > 20 * SLOTS
    assert {len(slots) for slots in killed.values()} == set(range(SLOTS + 1))


def test_no_acknowledged_slot_is_lost(killed: dict[Path, list[int]]) -> None:
    for state, acknowledged in killed.items():
        with open_store(state) as store:
            assert store.measured_slots() >= {slot(number) for number in acknowledged}


def test_every_row_has_its_frames(killed: dict[Path, list[int]]) -> None:
    for state in killed:
        archive = FrameArchive(state)
        with open_store(state) as store:
            for number in range(SLOTS):
                if store.measurement(slot(number)):
                    read = archive.load(slot(number))
                    assert np.array_equal(read.main.pixels, pair(number).main.pixels)
                    assert read.skew_s == pair(number).skew_s


def test_what_is_left_can_be_taken_up_and_finished(
    killed: dict[Path, list[int]], tmp_path: Path
) -> None:
    """Mend, measure the orphans late, go on: at the end there is one row a slot, and no gap."""
    orphans_seen = 0
    for original in killed:
        state = tmp_path / original.name
        shutil.copytree(original, state)
        archive = FrameArchive(state)
        with open_store(state) as store:
            archive.repair()
            orphans = archive.orphans(store.measured_slots())
            orphans_seen += len(orphans)
            for late in orphans:
                number = (late - slot(0)).seconds // PERIOD_S
                assert np.array_equal(archive.load(late).sub.pixels, pair(number).sub.pixels)
                store.add_measurement(full_record(late))
            for number in range(SLOTS):
                if slot(number) not in store.measured_slots():
                    archive.store(slot(number), pair(number))
                    store.add_measurement(full_record(slot(number)))
            assert store.gaps() == []
            found = store.coverage(slot(0), slot(SLOTS), period_s=PERIOD_S)
            assert (found.suspect, found.unaccounted) == (SLOTS, 0)
        rows = read_frame_set(state / "frames/2026/03/01").rows
        assert [row.slot_utc for row in rows] == [slot(number) for number in range(SLOTS)]
        assert not list(state.rglob(".*"))
    assert orphans_seen > SLOTS


def test_frames_then_line_then_row_then_acknowledgement(tmp_path: Path) -> None:
    """The order of the system calls, as the kernel sees them: the right one to lose power in."""
    trace = tmp_path / "trace"
    calls = "fsync,fdatasync,rename,renameat,renameat2,write,pwrite64,mkdir"
    options = ("-y", "-s", "16", "-o", str(trace), "-e", f"trace={calls}")
    state = tmp_path / "state"
    assert traced(options, WRITER, state) == 0
    day = f"{state}/frames/2026/03/01"
    wanted = [
        rf'mkdir\("{day}"',
        rf"fsync\(\d+<{state}/frames/2026/03>\)",
        rf"fsync\(\d+<{day}/\.000000_main\.png\.tmp>\)",
        rf'rename\w*\(.*"{day}/000000_main\.png"',
        rf"fsync\(\d+<{day}>\)",
        rf"fsync\(\d+<{day}/\.000000_sub\.png\.tmp>\)",
        rf'rename\w*\(.*"{day}/000000_sub\.png"',
        rf"fsync\(\d+<{day}>\)",
        rf'rename\w*\(.*"{day}/frames\.csv"',
        rf"fsync\(\d+<{day}>\)",
        rf"pwrite64\(\d+<{state}/dcam\.db-wal>",
        rf"f(data)?sync\(\d+<{state}/dcam\.db-wal>\)",
        r'write\(1<.*"state 0\\n"',
        rf'rename\w*\(.*"{day}/000100_sub\.png"',
        rf"fsync\(\d+<{day}>\)",
        rf"write\(\d+<{day}/frames\.csv>",
        rf"fsync\(\d+<{day}/frames\.csv>\)",
        rf"f(data)?sync\(\d+<{state}/dcam\.db-wal>\)",
        r'write\(1<.*"state 1\\n"',
    ]
    lines = iter(trace.read_text().splitlines())
    for pattern in wanted:
        assert any(re.search(pattern, line) for line in lines), f"not in this order: {pattern}"
    everything = trace.read_text().splitlines()
    (reported,) = (at for at, line in enumerate(everything) if '"state 0' in line)
    assert re.search(r"f(data)?sync\(.*dcam\.db-wal>", everything[reported - 1])
