"""What the package leaves out of other projects' wheels is not missed, and it stays small."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from tests.shared import shared_directory

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = re.findall(r"\[([\w,]+)\]\"$", (ROOT / "deploy/build-venv").read_text(), re.MULTILINE)[0]
UNPACKED_MB = 540
"""docs/decisions/0034 says where it goes. Who needs more says there why."""

EVERY_EXTRA = """
import gc, io, sys
gc.disable()  # of all that is loaded nothing becomes garbage
import numpy, cv2, scipy.optimize, scipy.stats, scipy.signal
assert all(cv2.imencode(kind, numpy.zeros((9, 9), "u1"))[0] for kind in (".png", ".jpg", ".tiff"))
many = numpy.random.default_rng(1).normal(size=(90, 90))  # beyond what OpenCV works out by itself
assert numpy.allclose(cv2.gemm(many, many, 1, None, 0), many @ many)
assert numpy.allclose(cv2.invert(many)[1] @ many, numpy.eye(90))

import matplotlib
matplotlib.use("agg")
from matplotlib import pyplot
pyplot.plot([1, 2], label=r"$\\sigma_x$ in µm")
pyplot.legend()
for kind in ("png", "svg", "pdf"):
    pyplot.savefig(io.BytesIO(), format=kind)

import h5netcdf
with h5netcdf.File(sys.argv[1] + "/table.nc", "w") as file:
    file.dimensions = {"time": 3}
    file.create_variable("x", ("time",), "f8", data=numpy.arange(3.0))

import apprise
assert apprise.Apprise().add("mailto://a:b@example.org")
assert apprise.Apprise().add("ntfy://example.org/a")

import zoneinfo
zoneinfo.ZoneInfo("Europe/Berlin")

import harvesters.core, pymodbus.client, serial, prometheus_client, reportlab.graphics.renderPDF
import numba
assert numba.njit(lambda values: values.sum())(many) > many.sum() - 1e-9
assert scipy.optimize.least_squares(lambda x: x - many[0], many[1]).success
import core, daemon.slots.measuring
"""


def needed() -> list[Distribution]:
    """What `pip install dcam[...]` of build-venv brings, as it is installed here."""
    found: dict[str, Distribution] = {}
    optional = PROJECT["optional-dependencies"]
    wanted = [Requirement(text) for text in PROJECT["dependencies"]]
    wanted += [Requirement(text) for extra in EXTRAS.split(",") for text in optional[extra]]
    while wanted:
        requirement = wanted.pop()
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        extras = ["", *requirement.extras]
        marker = requirement.marker
        if name in found or (marker and not any(marker.evaluate({"extra": e}) for e in extras)):
            continue
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            pytest.fail(f"{name} is not installed here: make venv")
        for text in found[name].requires or []:
            below = Requirement(text)
            if below.marker is None or any(below.marker.evaluate({"extra": e}) for e in extras):
                below.marker = None
                wanted.append(below)
    return list(found.values())


def copy(names: Iterable[str], source: Path, site: Path) -> None:
    """Put files below another directory; those that are not there, or lie elsewhere, stay away.

    Only libraries are written to: of all others the same file is named once more, where it can be.
    """
    made = set()
    for name in names:
        file, target = source / name, site / name
        if ".." in file.parts or not file.is_file():
            continue
        if target.parent not in made:
            target.parent.mkdir(parents=True, exist_ok=True)
            made.add(target.parent)
        if ".so" not in file.name:
            with contextlib.suppress(OSError):
                target.hardlink_to(file)
                continue
        shutil.copy2(file, target)


@pytest.fixture(scope="session")
def trimmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment as build-venv makes it, of what is installed here; not to be changed."""

    def fill(directory: Path) -> None:
        subprocess.run(
            [sys.executable, "-m", "venv", "--system-site-packages", "--without-pip", directory],
            check=True,
        )
        (site,) = directory.glob("lib/python*/site-packages")
        for each in needed():
            copy(map(str, each.files or []), Path(str(each.locate_file(""))), site)
        own = distribution("dcam")
        known = [str(file) for file in own.files or [] if "dist-info" in str(file)]
        copy(known, Path(str(own.locate_file(""))), site)
        for ours in ("core", "drivers", "daemon", "migrations"):
            copy([str(file.relative_to(ROOT)) for file in (ROOT / ours).rglob("*")], ROOT, site)
        subprocess.run(
            [directory / "bin/python3", ROOT / "deploy/trim_venv.py", "--libraries"], check=True
        )

    return shared_directory(tmp_path_factory, "trimmed", fill)


needs_tools = pytest.mark.skipif(
    not all(shutil.which(tool) for tool in ("eu-strip", "gcc", "readelf")),
    reason="elfutils or gcc is not installed",
)


@needs_tools
def test_everything_works_without_what_was_left_out(trimmed: Path, tmp_path: Path) -> None:
    ran = subprocess.run(
        [trimmed / "bin/python3", "-B", "-c", EVERY_EXTRA, tmp_path],
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr


@needs_tools
def test_the_environment_stays_below_its_bound(trimmed: Path) -> None:
    files = [file for file in trimmed.rglob("*") if "__pycache__" not in file.parts]
    unpacked = sum(file.lstat().st_size for file in files if not file.is_dir())
    assert unpacked < UNPACKED_MB * 1e6


@needs_tools
def test_byte_code_is_made_for_what_is_loaded(trimmed: Path) -> None:
    listed = set((trimmed / "loaded-modules").read_text().splitlines())
    (site,) = trimmed.glob("lib/python*/site-packages")
    prefix = site.relative_to(trimmed)
    for used in (
        "daemon/main.py",
        "daemon/commands/export.py",
        "matplotlib/backends/backend_pdf.py",
    ):
        assert f"{prefix}/{used}" in listed
    assert all((trimmed / file).is_file() for file in listed)


@needs_tools
def test_video_ends_with_one_line(trimmed: Path) -> None:
    """FFmpeg is left out of OpenCV: nothing of dcam's asks for it."""
    ran = subprocess.run(
        [trimmed / "bin/python3", "-c", "import cv2; cv2.VideoCapture('film.mp4')"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode != 0
    assert ran.stderr.strip() == "dcam: OpenCV cannot read or write video in this installation"
