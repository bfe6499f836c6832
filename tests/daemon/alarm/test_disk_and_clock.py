"""A disk that is really filled and a kernel that says its clock runs free: raised and cleared."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.daemon.alarm.conftest import WebServer, configure, words
from tests.daemon.commands.conftest import Site

DCAM_CTL = str(Path(sys.executable).with_name("dcam-ctl"))

FILL = """
set -eu
disk=$1 state=$2 ballast=$1/ballast
shift 2
mount -t tmpfs -o size=230m tmpfs "$disk" || exit 77
cp -a "$state/." "$disk/"
head -c 60M /dev/zero >"$ballast"
for look in 1 2; do "$@" || exit; done
rm "$ballast"
mount -o remount,size=4g "$disk"
"$@"
"""
"""Run by sh in a mount namespace of its own, so that the disk is gone with it."""
REFUSED = 77


def lines_of(web: WebServer, name: str) -> list[str]:
    """What was sent of one alarm."""
    lines = [line for text in web.texts() for line in text.splitlines()]
    return [line for line in lines if line.startswith(f"{name}: ")]


def looks(site: Site, state: Path) -> list[str]:
    return [DCAM_CTL, "--config", str(site.config), "--state", str(state), "alarm", *words(site)]


def test_a_disk_that_fills_is_raised_once_and_cleared(
    site: Site,
    web: WebServer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Of 230 MiB 60 are taken: less than 200 MB are free. Then they are given back, and 4 GiB."""
    configure(site, f'urls = ["{web.url}"]\nafter_min = 0')
    (tmp_path / "disk").mkdir()
    command = ["unshare", "--mount", "--map-root-user", "sh", "-c", FILL, "sh"]
    places = [str(tmp_path / "disk"), str(site.state)]
    ran = subprocess.run(
        [*command, *places, *looks(site, tmp_path / "disk")], check=False, capture_output=True
    )
    is_refused = ran.returncode == REFUSED or b"unshare" in ran.stderr
    if is_refused:
        with capfd.disabled():
            sys.stderr.write(f"no disk may be mounted: {ran.stderr!r}; its figures are made up\n")
        with_other_figures(site, monkeypatch)
    else:
        assert ran.returncode == 0, ran.stderr
    raised, cleared = lines_of(web, "disk")
    assert raised.startswith("disk: critical since")
    assert is_refused or "MB of 241 MB free" in raised
    assert "free some space" in raised
    assert cleared.startswith("disk: cleared")


def with_other_figures(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two looks at a disk that is said to be full, and one at one that is not."""
    real = shutil.disk_usage(site.state)
    for free in (10**8, 10**8, 10**12):
        figures = real._replace(free=free)
        monkeypatch.setattr(shutil, "disk_usage", lambda _path, figures=figures: figures)
        assert site.ctl("alarm", *words(site)).code == 0


def test_a_clock_that_nothing_disciplines_is_raised_once_and_cleared(
    site: Site, web: WebServer
) -> None:
    """The kernel's answer to adjtimex(2) is TIME_ERROR, then TIME_OK: strace gives it."""
    configure(site, f'urls = ["{web.url}"]\nafter_min = 0\nlevel = "warning"')
    real_clock = site.config.read_text().replace("[simulation]", '[simulation]\nclock = "system"')
    site.config.write_text(real_clock)
    for answer in (5, 5, 0):
        calls = "adjtimex,clock_adjtime"
        inject = [*("strace", "-f", "-qq", "-o", "/dev/null", "-e", f"trace={calls}")]
        inject += ["-e", f"inject={calls}:retval={answer}"]
        command = [*inject, *looks(site, site.state)]
        ran = subprocess.run(command, check=False, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
    raised, cleared = lines_of(web, "clock")
    assert raised.startswith("clock: warning since")
    assert "not synchronised; check chronyc tracking or timedatectl" in raised
    assert cleared.startswith("clock: cleared")
