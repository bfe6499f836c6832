"""Compiled loops are kept from one process to the next; what keeps them from it stops nobody."""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import core
from core.compiled import kept_on_disk

ROOT = Path(__file__).parents[2]
LOOP = """
from callee import increment
from core.compiled import kept_on_disk

@kept_on_disk(nogil=True)
def add_one(number):
    return number + increment()

print(add_one(1), sum(add_one.stats.cache_hits.values()))
"""
CALLEE = """
from core.compiled import part_of_loops

INCREMENT = 1

@part_of_loops(nogil=True)
def increment():
    return INCREMENT
"""


NURSERY = """
import json, os, resource, runpy, sys
import numba
import core.compiled

numba.njit(lambda number: number)(1)
for line in sys.stdin:
    order = json.loads(line)
    if os.fork() == 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (order["limit"], order["limit"]))
        numba.config.CACHE_DIR = order["cache"]
        sys.path[:0] = [os.path.dirname(order["program"])]
        runpy.run_path(order["program"], run_name="__main__")
        print("done", flush=True)
        os._exit(0)
    _, status = os.wait()
    if status:
        print("failed", flush=True)
"""
"""Gets Numba ready once, which takes two seconds, and forks a process for each program."""


@pytest.fixture(scope="module")
def nursery() -> Iterator[subprocess.Popen[str]]:
    """Where programs are started, as new as one from the shell but for their imports."""
    with subprocess.Popen(
        [sys.executable, "-B", "-c", NURSERY],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        yield process
        process.stdin.close()


class Program:
    """One that runs a compiled loop, and where Numba is to keep it."""

    def __init__(self, directory: Path, nursery: subprocess.Popen[str]) -> None:
        self._file, self.cache = directory / "loop.py", directory / "cache"
        self._file.write_text(LOOP)
        self._nursery = nursery
        self.callee = directory / "callee.py"
        self.callee.write_text(CALLEE)
        self.limit = resource.RLIM_INFINITY
        """Bytes that a file may have; more is refused as on a full disk."""

    def run(self) -> list[int]:
        """Give what the loop gives, and how often it was found compiled."""
        order = {"program": str(self._file), "cache": str(self.cache), "limit": self.limit}
        print(json.dumps(order), file=self._nursery.stdin, flush=True)
        said = [self._nursery.stdout.readline().strip()]
        while said[-1] not in {"done", "failed", ""}:
            said.append(self._nursery.stdout.readline().strip())
        assert said[-1] == "done", said
        return [int(word) for word in said[0].split()]


@pytest.fixture
def program(tmp_path: Path, nursery: subprocess.Popen[str]) -> Program:
    return Program(tmp_path, nursery)


def test_a_loop_is_compiled_once(program: Program) -> None:
    assert program.run() == [2, 0]
    assert program.run() == [2, 1]


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("left", [0, 20])
def test_files_that_a_power_cut_left_short_are_made_again(
    program: Program, suffix: str, left: int
) -> None:
    """Numba does not sync them; each is there with its name, and empty or half."""
    program.run()
    files = list(program.cache.rglob(f"*{suffix}"))
    assert files
    for file in files:
        os.truncate(file, left)
    assert program.run() == [2, 0]
    assert program.run() == [2, 1]


@pytest.mark.parametrize(
    ("old", "new"), [("INCREMENT = 1", "INCREMENT = 2"), ("return INCREMENT", "return 2")]
)
def test_a_new_version_of_what_a_loop_calls_is_run(program: Program, old: str, new: str) -> None:
    """As after an upgrade: the loop's own file is the same, code of another is compiled into it."""
    program.run()
    program.callee.write_text(CALLEE.replace(old, new))
    assert program.run() == [3, 0]
    assert program.run() == [3, 1]


def test_a_loop_with_other_options_is_another(program: Program) -> None:
    program.run()
    program.callee.write_text(CALLEE.replace("nogil=True", "nogil=True, boundscheck=True"))
    assert program.run() == [2, 0]


def test_machine_code_that_a_power_cut_has_damaged_is_not_run(program: Program) -> None:
    """Some file systems leave a file of the right length with blocks of zeros in it."""
    program.run()
    (file,) = program.cache.rglob("loop.add_one*.nbc")
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(64)
    file.write_bytes(content)
    assert program.run() == [2, 0]
    assert program.run() == [2, 1]


def test_a_loop_that_cannot_be_kept_runs_all_the_same() -> None:
    """Text that comes from no file has nowhere to be kept."""
    names: dict[str, Callable[[int], int]] = {}
    exec("def add_one(number):\n    return number + 1\n", names)
    assert kept_on_disk()(names["add_one"])(1) == 2


def test_a_full_disk_costs_the_keeping_only(program: Program) -> None:
    """A file may be made, and nothing written to it."""
    program.limit = 0
    assert program.run() == [2, 0]


def test_what_loops_call_is_inlined_and_not_kept() -> None:
    """Else a loop that was just compiled and one read from the cache differ in the last digits."""
    names = [found.name for found in pkgutil.walk_packages(core.__path__, "core.")]
    modules = [importlib.import_module(name) for name in (*names, "drivers.sim.kernels")]
    loops = {
        value.py_func.__qualname__: value
        for module in modules
        for value in vars(module).values()
        if hasattr(value, "py_func")
    }
    assert len(loops) > 40
    called = {
        name: loop.py_func.__globals__[name]
        for loop in loops.values()
        for name in loop.py_func.__code__.co_names
        if hasattr(loop.py_func.__globals__.get(name), "py_func")
    }
    assert len(called) > 20
    apart = [name for name, callee in called.items() if "forceinline" not in callee.targetoptions]
    assert not apart
