"""`dcam-ctl reprocess` on workers, from a tree or a URL, interrupted: always the same bytes."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import dask
import fsspec
import pytest
import structlog
from distributed import LocalCluster

from daemon.commands import reprocess as reprocess_command
from daemon.errors import WorkFailedError
from daemon.reprocessing import chunks, cluster, running
from daemon.reprocessing.parts import Parts
from daemon.slots.identity import own_identity
from drivers.frameset import FrameSetRow, read_frame_set, write_table
from tests.daemon.commands.conftest import Ctl, rows_of
from tests.processes import descendants, is_alive, open_files
from tests.programs import ran as ran_program
from tests.waiting import wait_for

# Of `distributed`, on a computer without a network.
pytestmark = pytest.mark.filterwarnings("ignore:Couldn't detect a suitable IP:RuntimeWarning")

DCAM_CTL = Path(sys.executable).with_name("dcam-ctl")
LONG = 41
"""Slots: three chunks."""


def long_set(further: Path, directory: Path) -> Path:
    """The measure rows of the set with a fixed target, over and over, a minute apart."""
    shown = read_frame_set(further / "set").rows_of("measure")
    directory.mkdir()
    rows = []
    for number in range(LONG):
        row = shown[number % len(shown)]
        main, sub = (f"{number:04}_{role}.png" for role in ("main", "sub"))
        shutil.copy(further / "set" / str(row.main), directory / main)
        shutil.copy(further / "set" / str(row.sub), directory / sub)
        slot_utc = shown[0].slot_utc + timedelta(minutes=number)
        rows.append(FrameSetRow(slot_utc, "measure", main, sub, extra=row.extra))
    write_table(directory, rows)
    return directory


def arguments(site: Path, frames: object, output: Path, *more: object) -> list[str]:
    """A command line."""
    paths = ("--config", site / "dcam.toml", "--state", site / "state")
    words = (*paths, "reprocess", "--from", frames, "--output", output, *more)
    return [str(word) for word in words]


def test_a_worker_that_is_killed_in_the_middle_changes_no_bit(
    further: Path, ctl: Ctl, tmp_path: Path
) -> None:
    """Its image is a pipe: whoever reads it is in the middle of a chunk, and is killed there.

    The first image is one, too: the process itself waits for it until workers are there.
    """
    frames = long_set(further, tmp_path / "long")
    image, aside = frames / "0024_main.png", tmp_path / "aside.png"
    first = frames / "0000_main.png"
    shown = first.read_bytes()
    image.rename(aside)
    first.unlink()
    os.mkfifo(image)
    os.mkfifo(first)
    two = sorted(os.sched_getaffinity(0))[:2]
    shared, serial = tmp_path / "shared.csv", tmp_path / "serial.csv"
    command = [DCAM_CTL, *arguments(further, frames, shared, "--scheduler", "local")]
    with subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: os.sched_setaffinity(0, two),  # noqa: PLW1509 - it takes no lock
    ) as process:
        line = process.stderr.readline()
        while "2 workers have started" not in line:
            assert line
            line = process.stderr.readline()
        first.write_bytes(shown)
        with image.open("wb"):  # returns when a worker opens it
            wait_for(lambda: readers_of(image, process.pid), "the worker to be found")
            (worker,) = readers_of(image, process.pid)
            aside.replace(image)
            os.kill(worker, signal.SIGKILL)
            wait_for(lambda: not is_alive(worker), "the worker's end")
        _, err = process.communicate()
    assert process.returncode == 0, err
    first.unlink()
    first.write_bytes(shown)
    assert ctl(*arguments(further, frames, serial, "--scheduler", "serial")).code == 0
    assert shared.read_bytes() == serial.read_bytes()
    assert len(rows_of(serial)) == LONG
    assert len(err.splitlines()) == len([line for line in err.splitlines() if "dcam-ctl:" in line])


def readers_of(file: Path, parent: int) -> list[int]:
    """The processes that a process has started, and those they have, with a file open."""
    return [pid for pid in descendants(parent) if str(file.resolve()) in open_files(pid)]


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two slots a chunk, and every run worth keeping."""
    monkeypatch.setattr(chunks, "CHUNK_SLOTS", 2)
    monkeypatch.setattr(reprocess_command, "WORTH_SHARING", 1)


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The slots that are looked at, as they are; tests may clear it."""
    looked: list[str] = []
    see_chunk = running.see_chunk

    def watched(work, chunk):
        content = see_chunk(work, chunk)
        looked.extend(f"{frames.slot_utc:%H:%M}" for frames in chunk)
        return content

    monkeypatch.setattr(running, "see_chunk", watched)
    return looked


def interrupted(ctl: Ctl, monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    """Run it, with an interrupt at the second chunk."""
    see_chunk, calls = running.see_chunk, []

    def once(work, chunk):
        calls.append(chunk)
        if len(calls) > 1:
            raise KeyboardInterrupt
        return see_chunk(work, chunk)

    with monkeypatch.context() as broken:
        broken.setattr(running, "see_chunk", once)
        assert ctl(*words).code != 0


@pytest.mark.usefixtures("small_chunks")
def test_an_interrupted_run_goes_on_where_it_was(
    further: Path, ctl: Ctl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seen: list[str]
) -> None:
    output, whole = tmp_path / "out.csv", tmp_path / "whole.csv"
    words = arguments(further, further / "set", output)
    interrupted(ctl, monkeypatch, words)
    assert not output.exists()
    (kept,) = tmp_path.glob(".out.csv.parts")
    assert kept.stat().st_mode & 0o077 == 0
    seen.clear()
    ran = ctl(*words)
    assert ran.code == 0
    assert len(seen) == 2
    assert "1 chunks" in ran.err
    assert not kept.exists()
    ctl(*arguments(further, further / "set", whole))
    assert output.read_bytes() == whole.read_bytes()


@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("what", ["frame", "config", "damage"])
def test_what_has_changed_since_the_interrupt_is_measured_again(
    further: Path, ctl: Ctl, tmp_path: Path, monkeypatch, seen: list[str], what: str
) -> None:
    site, output = tmp_path / "site", tmp_path / "out.csv"
    shutil.copytree(further, site)
    words = arguments(site, site / "set", output)
    interrupted(ctl, monkeypatch, words)
    seen.clear()
    if what == "frame":
        first = read_frame_set(site / "set").rows_of("measure")[0]
        (site / "set" / str(first.main)).write_bytes(b"")
    elif what == "config":
        text = (site / "dcam.toml").read_text()
        (site / "dcam.toml").write_text(text.replace("diameter_mm = 7.0", "diameter_mm = 7.001"))
    else:
        (part,) = (tmp_path / ".out.csv.parts").iterdir()
        part.write_bytes(part.read_bytes()[:-1])
    assert ctl(*words).code == 0
    assert len(seen) == 4


@pytest.fixture
def workers(monkeypatch: pytest.MonkeyPatch) -> Iterator[LocalCluster]:
    """A scheduler with one worker, a thread of this process; nobody waits long for others."""
    monkeypatch.setattr(cluster, "ALONE_S", 0.2)
    monkeypatch.setattr(cluster, "_LOOK_S", 0.1)
    logs = structlog.get_config()
    options = {"processes": False, "dashboard_address": ":0", "silence_logs": logging.CRITICAL}
    with (
        dask.config.set(cluster._SETTINGS),
        LocalCluster(1, threads_per_worker=1, **options) as made,
    ):
        yield made
    structlog.configure(**logs)


@pytest.mark.usefixtures("small_chunks")
def test_a_run_that_loses_all_its_workers_ends_with_a_line_and_goes_on_later(
    further: Path, ctl: Ctl, tmp_path: Path, workers: LocalCluster, monkeypatch, seen: list[str]
) -> None:
    output, whole = tmp_path / "out.csv", tmp_path / "whole.csv"
    words = arguments(further, further / "set", output)
    save = Parts.save

    def last_of_its_worker(parts: Parts, key: str, content: bytes) -> None:
        save(parts, key, content)
        workers.scale(0)
        wait_for(lambda: not workers.scheduler_info["workers"], "the worker's end")

    with monkeypatch.context() as dying:
        dying.setattr(Parts, "save", last_of_its_worker)
        ran = ctl(*words, "--scheduler", workers.scheduler_address)
    assert ran.code == 4
    (line,) = (line for line in ran.err.splitlines() if "error" in line)
    assert "no worker is left since 0.2 s; start some, and run it again to go on" in line
    assert "Traceback" not in ran.err
    assert not output.exists()
    ran = ctl(*words)
    assert ran.code == 0
    assert "1 chunks of" in ran.err
    assert len(seen) == 2
    ctl(*arguments(further, further / "set", whole))
    assert output.read_bytes() == whole.read_bytes()


@pytest.mark.usefixtures("small_chunks")
def test_parts_in_a_directory_that_others_may_write_to_are_not_read(
    further: Path, ctl: Ctl, tmp_path: Path
) -> None:
    (tmp_path / ".out.csv.parts").mkdir(mode=0o777)
    (tmp_path / ".out.csv.parts").chmod(0o777)
    ran = ctl(*arguments(further, further / "set", tmp_path / "out.csv"))
    assert ran.code == 1
    assert "not a directory of yours alone" in ran.err


def test_a_tree_of_days_is_measured_as_one(further: Path, ctl: Ctl, tmp_path: Path) -> None:
    """What the archive looks like: rows hang on those of the day before, as within one set."""
    whole = read_frame_set(further / "set").rows_of("measure")
    for part, rows in (("2026/03/01", whole[:2]), ("2026/03/02", whole[2:])):
        day = tmp_path / "frames" / part
        day.mkdir(parents=True)
        for row in rows:
            shutil.copy(further / "set" / str(row.main), day)
            shutil.copy(further / "set" / str(row.sub), day)
        write_table(day, rows)
    one, tree = tmp_path / "one.csv", tmp_path / "tree.csv"
    ctl(*arguments(further, further / "set", one))
    for place in (tmp_path, tmp_path / "frames"):
        assert ctl(*arguments(further, place, tree)).code == 0
        assert tree.read_bytes() == one.read_bytes()
    _assert_no_day_is_listed_to_find_its_table(further, ctl, tmp_path, one)
    write_table(tmp_path / "frames/2026/03/02", whole[1:3])
    ran = ctl(*arguments(further, tmp_path, tree))
    assert ran.code == 4
    assert "2026/03/02/frames.csv: begins before the set before it ends" in ran.err


def _assert_no_day_is_listed_to_find_its_table(
    further: Path, ctl: Ctl, tmp_path: Path, one: Path
) -> None:
    """An archive of ten years has ten million images, whose names would fill the memory."""
    storage, output = fsspec.filesystem("memory"), tmp_path / "url.csv"
    storage.put(str(tmp_path / "frames"), "/bridge/frames", recursive=True)
    listed: list[str] = []

    def ls(path, *arguments, **options):
        listed.append(path)
        return type(storage).ls(storage, path, *arguments, **options)

    with pytest.MonkeyPatch.context() as watched:
        watched.setattr(storage, "ls", ls)
        for place in ("memory://bridge", "memory://bridge/frames"):
            ran = ctl(*arguments(further, place, output))
            assert ran.code == 0, ran.err
            assert output.read_bytes() == one.read_bytes()
    assert "/bridge/frames/2026/03" in listed
    assert not [path for path in listed if "2026/03/" in path]


KEYS = {
    "AWS_ACCESS_KEY_ID": "any",
    "AWS_SECRET_ACCESS_KEY": "any",
    "AWS_DEFAULT_REGION": "us-east-1",
}


@pytest.fixture
def s3() -> Iterator[tuple[dict[str, str], subprocess.Popen[bytes]]]:
    """A server of S3, and the environment in which it is found."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
        wait_for(lambda: answers(port), "the server")
        yield os.environ | KEYS | {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}, server
        server.kill()


def answers(port: int) -> bool:
    """Whether somebody listens there."""
    with socket.socket() as tried:
        return tried.connect_ex(("127.0.0.1", port)) == 0


UPLOAD = """
import sys, fsspec
storage = fsspec.filesystem("s3")
storage.mkdir("bridge")
storage.put(sys.argv[1], "bridge/march", recursive=True)
"""


def test_frames_in_s3_are_measured_as_those_on_a_disk(
    further: Path, ctl: Ctl, tmp_path: Path, s3
) -> None:
    """And a storage that does not answer is an error, never a row that says the image is bad."""
    environment, server = s3
    upload = tmp_path / "upload.py"
    upload.write_text(UPLOAD)
    assert ran_program(upload, further / "set", env=environment).returncode == 0
    here, there = tmp_path / "here.csv", tmp_path / "there.csv"
    words = arguments(further, "s3://bridge/march", there)
    assert ran_program("daemon.ctl", *words, env=environment).returncode == 0
    ctl(*arguments(further, further / "set", here))
    assert there.read_bytes() == here.read_bytes()
    server.kill()
    server.wait()
    there.unlink()
    ran = ran_program("daemon.ctl", *words, env=environment)
    assert ran.returncode == 4
    assert "s3://bridge/march" in ran.stderr
    assert len(ran.stderr.splitlines()) == 1
    assert not there.exists()


def test_workers_of_another_version_are_refused_and_named() -> None:
    own = own_identity()
    assert own.differences(own) == ""
    cluster._require_alike(own, "tcp://10.0.0.7:4711")
    versions = tuple((name, "0.9" if name == "scipy" else of) for name, of in own.versions)
    with pytest.raises(WorkFailedError, match=r"tcp://10\.0\.0\.7:4711: scipy 0\.9 there, \d"):
        cluster._require_alike(replace(own, versions=versions), "tcp://10.0.0.7:4711")


def test_a_scheduler_that_does_not_answer_is_one_line(further: Path, tmp_path: Path) -> None:
    words = arguments(further, further / "set", tmp_path / "out.csv")
    ran = ran_program("daemon.ctl", *words, "--scheduler", "tcp://127.0.0.1:9")
    assert ran.returncode == 4
    assert "error: tcp://127.0.0.1:9: no scheduler answers" in ran.stderr.splitlines()[-1]
    assert "Traceback" not in ran.stderr
