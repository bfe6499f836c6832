"""`dcam-ctl reprocess` whose workers do not start: one line that says what, where, what to do."""

from __future__ import annotations

import os
import subprocess
from datetime import timedelta
from pathlib import Path

import pytest

from drivers.frameset import FrameSetRow, read_frame_set, write_table
from tests.daemon.commands.conftest import Ctl
from tests.daemon.commands.test_reprocess_workers import DCAM_CTL, arguments

ENDLESS = 4_000
"""Slots: more than are measured before workers fail to start; the run ends with that.

To measure them takes twenty times as long; to read a table of ten times as many, as long again."""
ONLY_IN_WORKERS = """
import sys

class Broken:
    def find_spec(self, name, path=None, target=None):
        if name == "distributed.nanny":
            raise RuntimeError("broken on purpose")

if not any("dcam-ctl" in word for word in sys.orig_argv):
    sys.meta_path.insert(0, Broken())
"""


@pytest.fixture(scope="module")
def endless(further: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A frame set of the same images over and over."""
    directory = tmp_path_factory.mktemp("endless")
    shown = read_frame_set(further / "set").rows_of("measure")[0]
    for name in (shown.main, shown.sub):
        os.link(further / "set" / str(name), directory / str(name))
    minutes = (shown.slot_utc + timedelta(minutes=number) for number in range(ENDLESS))
    rows = [FrameSetRow(utc, "measure", shown.main, shown.sub, extra={}) for utc in minutes]
    write_table(directory, rows)
    return directory


def last_line(further: Path, frames: Path, tmp_path: Path, code: int, **environ: object) -> str:
    """What the run says at its end; nothing else but how far it has come stands before it."""
    words = arguments(further, frames, tmp_path / "out.csv", "--scheduler", "local")
    environment = os.environ | {name: str(value) for name, value in environ.items()}
    ran = subprocess.run(
        [DCAM_CTL, *words], check=False, capture_output=True, text=True, env=environment
    )
    *others, last = ran.stderr.splitlines()
    assert ran.returncode == code, ran.stderr
    assert [line for line in others if not line.startswith("dcam-ctl: measuring, ")] == []
    assert not (tmp_path / "out.csv").exists()
    return last


def test_what_workers_cannot_load_is_named(further: Path, endless: Path, tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(ONLY_IN_WORKERS)
    assert last_line(further, endless, tmp_path, 1, PYTHONPATH=tmp_path) == (
        "dcam-ctl: error: no workers on this computer: daemon.reprocessing.of_workers cannot be "
        "loaded there: RuntimeError: broken on purpose; look at PYTHONPATH, or install dcam again; "
        "--scheduler serial measures without workers"
    )


def test_a_directory_that_workers_cannot_write_is_named(
    further: Path, endless: Path, tmp_path: Path
) -> None:
    scratch = tmp_path / "dask-scratch-space"
    scratch.touch()  # as unusable for the superuser, too
    last = last_line(further, endless, tmp_path, 4, TMPDIR=tmp_path)
    assert last.startswith(f"dcam-ctl: error: no workers on this computer: {scratch}/")
    assert f"({tmp_path}, TMPDIR names another)" in last


def test_a_dask_that_cannot_be_loaded_is_told_from_none(
    further: Path, endless: Path, tmp_path: Path
) -> None:
    (tmp_path / "distributed").mkdir()
    (tmp_path / "distributed/__init__.py").write_text("raise ImportError('libssl: not found')")
    last = last_line(further, endless, tmp_path, 1, PYTHONPATH=tmp_path)
    assert last.startswith("dcam-ctl: error: --scheduler needs dask (libssl: not found): ")


def test_an_address_that_needs_keys_is_a_mistake_of_usage(
    ctl: Ctl, further: Path, tmp_path: Path
) -> None:
    """Dask's own config may have them; without it raises what looked like an internal error."""
    words = arguments(further, further / "set", tmp_path / "out.csv")
    ran = ctl(*words, "--scheduler", "tls://127.0.0.1:9")
    assert ran.code == 2
    assert ran.err.splitlines()[-1].startswith("dcam-ctl: error: --scheduler tls://127.0.0.1:9: ")
