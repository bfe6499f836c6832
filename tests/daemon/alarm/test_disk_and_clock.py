"""A disk that is really filled and a kernel that says its clock runs free: raised and cleared."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.daemon.alarm.conftest import WebServer, configure, history, look, words
from tests.daemon.commands.conftest import MINUTE, Site

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


LOW_MB, SCARCE_MB, PLENTY_MB = 100, 500, 1_000_000
"""Free: critical, a warning, in order."""


@pytest.fixture
def free_mb(site: Site, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Have the disk say that so much is free."""
    real = shutil.disk_usage(site.state)

    def say(free: int) -> None:
        figures = real._replace(free=free * 10**6)
        monkeypatch.setattr(shutil, "disk_usage", lambda _path: figures)

    return say


def test_a_disk_that_is_no_longer_critical_is_sent_so_and_when_it_is_critical_again(
    site: Site, web: WebServer, free_mb: Callable[[int], None]
) -> None:
    configure(site, f'urls = ["{web.url}"]\nafter_min = 0')
    for free in (LOW_MB, SCARCE_MB, SCARCE_MB, LOW_MB, SCARCE_MB, PLENTY_MB):
        free_mb(free)
        assert look(site).code == 0
    raised, eased, again, eased_again, cleared = lines_of(web, "disk")
    assert raised.startswith("disk: critical since")
    assert eased.startswith("disk: no longer critical, warning since")
    assert "500 MB" in eased
    assert again.startswith("disk: critical since")
    assert eased_again.startswith("disk: no longer critical")
    assert cleared.startswith("disk: cleared")
    assert web.titles()[1] == "dcam bench: disk no longer critical"
    kinds = [one["kind"] for one in history(site) if one["name"] == "disk"]
    assert [kind for kind in kinds if kind != "sent"] == ["raised", *3 * ["changed"], "cleared"]


def test_a_disk_to_and_fro_across_a_limit_is_sent_once_until_it_has_stayed(
    site: Site, web: WebServer, free_mb: Callable[[int], None]
) -> None:
    configure(site, f'urls = ["{web.url}"]')
    for minute in (0, 16, 17, 18, 19):
        free_mb(SCARCE_MB if minute % 2 else LOW_MB)
        look(site, late=minute * MINUTE)
    for minute in (20, 35):
        assert changed_levels(site) == []
        free_mb(SCARCE_MB)
        look(site, late=minute * MINUTE)
    assert changed_levels(site) == ["warning"]
    assert "".join(web.texts()).count("disk: no longer critical") == 1


def test_what_is_cleared_but_still_a_warning_says_so(
    site: Site, web: WebServer, free_mb: Callable[[int], None]
) -> None:
    """Where a site does not want warnings of its disk."""
    configure(site, f'urls = ["{web.url}"]\nafter_min = 0\nwarnings = []')
    for free in (LOW_MB, SCARCE_MB):
        free_mb(free)
        look(site)
    _, cleared = lines_of(web, "disk")
    assert "disk: cleared" in cleared
    assert "still a warning: " in cleared
    assert "500 MB" in cleared
    assert web.titles()[1] == "dcam bench: cleared disk"


def changed_levels(site: Site) -> list[str]:
    happened = [(one["name"], one["kind"], one["level"]) for one in history(site)]
    return [level for name, kind, level in happened if (name, kind) == ("disk", "changed")]


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
