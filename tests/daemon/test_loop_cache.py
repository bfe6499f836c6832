"""Compiled loops are kept where the user of a program may write, or the program works without."""

from __future__ import annotations

import errno
import inspect
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from daemon.loop_cache import loop_cache


def test_the_services_user_shares_the_services_cache(tmp_path: Path) -> None:
    """So that a calibration by hand leaves the loops compiled for the service."""
    assert loop_cache({"HOME": "/nowhere"}, tmp_path) == str(tmp_path / "numba")


def test_what_the_environment_says_counts(tmp_path: Path) -> None:
    assert loop_cache({"NUMBA_CACHE_DIR": "/x"}, tmp_path) is None


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_a_user_who_may_write_nowhere_gets_a_folder_of_his_own() -> None:
    """As a monitoring system runs `status`: Numba would refuse to work."""
    with tempfile.TemporaryDirectory() as directory:
        module = Path(directory) / "daemon" / "loop_cache.py"
        module.parent.mkdir()
        shutil.copyfile(str(inspect.getsourcefile(loop_cache)), module)
        Path(directory).chmod(0o777)
        code = "import loop_cache; print(loop_cache.loop_cache({'HOME': '/proc'}))"
        done = subprocess.run(
            [os.path.realpath(sys.executable), "-B", "-c", code],
            cwd=module.parent,
            env={"TMPDIR": directory},
            user=65534,
            extra_groups=[],
            capture_output=True,
            text=True,
            check=True,
        )
        there = Path(done.stdout.strip()).stat()
        assert (there.st_uid, stat.S_IMODE(there.st_mode)) == (65534, 0o700)


def test_where_no_disk_can_be_written_to_programs_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with a root file system that an error has turned read-only."""

    def no_directory() -> str:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(tempfile, "gettempdir", no_directory)
    assert loop_cache({"HOME": "/"}, Path("/nowhere")) is None
