"""`make install`: what lands where, what an upgrade keeps, what a failure leaves.

Our own package only (`--no-deps`): what is installed beside it is pip's business.
"""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.ctl import cli
from daemon.error_report import run
from tests.deploy.scripts import MANUAL, OFFLINE, ROOT, deploy, documents_of_units, install, wheel

HELP2MAN = """#!/bin/sh
for word; do
  case $word in --output=*) echo page > "${word#--output=}" ;; esac
done
"""
MAN_PYTHON = """#!/bin/sh
cd "$3"
touch dcam.toml.5
for page in dcamd.8 dcam-web.8 dcam-ctl.1 dcam-ctl-status.1 dcam-ctl-simulate-site.1; do
  touch "$page.help" "$page.name"
done
"""
"""In the place of what takes long to write the man pages: test_deb.py looks at true ones."""

OWN_CONFIG = '[site]\nname = "ours"\n'


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> str:
    return wheel(tmp_path_factory)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory, built: str) -> Path:
    """A tree with one installation; not to be changed."""
    tree, programs = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("programs")
    for name, script in (("help2man", HELP2MAN), ("man-python", MAN_PYTHON)):
        (programs / name).write_text(script)
        (programs / name).chmod(0o755)
    path, man_python = f"{programs}:{os.environ['PATH']}", f"{programs}/man-python"
    done = install(tree, WHEEL=built, MANUAL="yes", COMPILE="yes", MAN_PYTHON=man_python, PATH=path)
    assert done.returncode == 0, done.stderr
    return tree


@pytest.fixture
def tree(installed: Path, tmp_path: Path) -> Path:
    """A copy of it; nobody writes into a file of a release, so those are the same ones."""
    releases = installed / "opt/dcam/releases"

    def put(source: str, target: str) -> None:
        (os.link if Path(source).is_relative_to(releases) else shutil.copy2)(source, target)

    return Path(shutil.copytree(installed, tmp_path / "tree", symlinks=True, copy_function=put))


def release(tree: Path) -> str:
    return str((tree / "opt/dcam/venv").readlink())


def test_what_the_service_needs_is_in_place(installed: Path) -> None:
    for name in (
        "lib/systemd/system/dcamd.service",
        "lib/systemd/system/dcam-alarm.service",
        "lib/systemd/system/dcam-alarm.timer",
        "lib/systemd/system/dcam-archive.service",
        "lib/systemd/system/dcam-archive.timer",
        "lib/systemd/system/dcam-report.service",
        "lib/systemd/system/dcam-report.timer",
        "lib/systemd/system/dcam-send.service",
        "lib/systemd/system/dcam-sync.service",
        "lib/systemd/system/dcam-sync.timer",
        "lib/systemd/system/dcam-web.service",
        "lib/sysusers.d/dcam.conf",
        "lib/tmpfiles.d/dcam.conf",
        "lib/sysctl.d/60-dcam.conf",
        "lib/udev/rules.d/60-dcam.rules",
        "share/dcam/config.example.toml",
        "share/doc/dcam/docs/install.md",
        *(f"share/bash-completion/completions/{program}" for program in ("dcamd", "dcam-ctl")),
        *(f"share/zsh/site-functions/_{program}" for program in ("dcamd", "dcam-ctl")),
        *(f"share/fish/vendor_completions.d/{program}.fish" for program in ("dcamd", "dcam-ctl")),
        *MANUAL,
    ):
        assert stat.S_IMODE((installed / "usr/local" / name).stat().st_mode) == 0o644
    for program in ("dcamd", "dcam-ctl", "dcam-web"):
        link = (installed / "usr/local/bin" / program).readlink()
        assert link == Path("/opt/dcam/venv/bin") / program
        first_line = (installed / "opt/dcam/venv/bin" / program).read_text().splitlines()[0]
        assert first_line.startswith(f"#!/opt/dcam/{release(installed)}/bin/python")


def test_units_name_documents_that_are_there(installed: Path) -> None:
    documents = documents_of_units(installed, "usr/local/lib/systemd/system")
    assert len(documents) == len(list((installed / "usr/local/lib/systemd/system").iterdir()))
    assert [path for path in documents if not path.is_file()] == []


def test_nothing_installed_names_the_place_it_was_made_in(installed: Path) -> None:
    """Programs, their config, compiled files with the paths that tracebacks show."""
    made_in = str(installed).encode()
    named = [
        path
        for path in installed.rglob("*")
        if path.is_file() and not path.is_symlink() and made_in in path.read_bytes()
    ]
    assert named == []


def test_byte_code_is_there_for_programs_with_docstrings_and_for_the_page_without(
    installed: Path,
) -> None:
    (made,) = (installed / "opt/dcam").glob("*/lib/python*/site-packages/daemon/__pycache__")
    kinds = {path.name.partition(".cpython-")[2][2:] for path in made.glob("web_main.*")}
    assert {kind.partition(".")[2] for kind in kinds} == {"pyc", "opt-2.pyc"}


def test_first_config_is_refused_until_it_is_the_sites_own(
    installed: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config = installed / "etc/dcam/dcam.toml"
    assert run(cli, "dcam-ctl", ["--config", str(config), "--state", str(tmp_path), "check"]) == 3
    assert "camera.main.serial: not set" in capfd.readouterr().out


def test_upgrade_keeps_config_and_data_and_the_release_before(tree: Path, built: str) -> None:
    config, data = tree / "etc/dcam/dcam.toml", tree / "var/lib/dcam/dcam.db"
    config.write_text(OWN_CONFIG)
    data.parent.mkdir(parents=True)
    data.write_bytes(b"rows")
    before = release(tree)

    done = install(tree, WHEEL=built)

    assert done.returncode == 0, done.stderr
    assert release(tree) != before
    assert (tree / "opt/dcam" / before / "bin/dcamd").is_file()
    assert (config.read_text(), data.read_bytes()) == (OWN_CONFIG, b"rows")

    done = deploy("uninstall", DESTDIR=str(tree))

    assert done.returncode == 0, done.stderr
    assert (config.read_text(), data.read_bytes()) == (OWN_CONFIG, b"rows")
    left = [path for path in tree.rglob("*") if not path.is_dir()]
    assert sorted(left) == sorted([config, data])
    assert "/var/lib/dcam" in done.stdout
    assert "/etc/dcam" in done.stdout


@pytest.mark.parametrize("broken", [{"PIP_FLAGS": "--no-such-flag"}, {"PYTHON": "/bin/false"}])
def test_a_step_that_fails_leaves_the_old_installation(
    tree: Path, built: str, broken: dict[str, str]
) -> None:
    before = release(tree)

    done = install(tree, WHEEL=built, **broken)

    assert done.returncode != 0
    assert "what was there is as it was" in done.stderr
    assert release(tree) == before
    assert list((tree / "opt/dcam/releases").iterdir()) == [tree / "opt/dcam" / before]


def test_an_environment_made_by_hand_gives_way(tree: Path) -> None:
    """It was a folder where now a link is; this is the last step of an installation."""
    made = release(tree).removeprefix("releases/")
    by_hand = tree / "opt/dcam/venv"
    by_hand.unlink()
    (by_hand / "bin").mkdir(parents=True)
    assert deploy("take-over", made, DESTDIR=str(tree)).returncode == 0
    assert by_hand.is_symlink()
    assert (tree / "opt/dcam/releases/before/bin").is_dir()


@pytest.mark.skipif(not shutil.which("systemd-sysusers"), reason="systemd is not installed")
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files to a user")
def test_user_and_directories_are_made_as_the_unit_wants_them(tree: Path) -> None:
    local = tree / "usr/local/lib"
    for command in (
        ["systemd-sysusers", f"--root={tree}", str(local / "sysusers.d/dcam.conf")],
        ["systemd-tmpfiles", f"--root={tree}", "--create", str(local / "tmpfiles.d/dcam.conf")],
    ):
        subprocess.run(command, check=True, capture_output=True)
    fields = (tree / "etc/passwd").read_text().split(":")
    user, uid, home, shell = fields[0], int(fields[2]), fields[5], fields[6].strip()
    assert (user, home, shell) == ("dcam", "/var/lib/dcam", "/usr/sbin/nologin")
    groups = (line.split(":") for line in (tree / "etc/group").read_text().splitlines())
    assert {group[0] for group in groups if group[3] == "dcam"} == {"dialout"}
    state = (tree / "var/lib/dcam").stat()
    assert (state.st_uid, stat.S_IMODE(state.st_mode)) == (uid, 0o750)


CONTAINER = """
set -eu
mount -t tmpfs tmpfs "$1"
for place in etc opt usr/local var run; do
  mkdir -p "$1/up/$place" "$1/work/$place"
  mount -t overlay overlay "/$place" \
    -o "lowerdir=/$place,upperdir=$1/up/$place,workdir=$1/work/$place"
done
rm -rf /run/systemd
mkdir "$1/bin"  # programs of a system without systemd
for place in /usr/sbin /usr/bin /bin; do
  ln -sf "$place"/* "$1/bin/"
done
rm -f "$1"/bin/system* "$1/bin/udevadm"
export PATH="$1/bin"
"$2" "$3"
echo "user: $(getent passwd dcam)"
stat -c "state: %U %a" /var/lib/dcam
ls /etc/dcam/dcam.toml /opt/dcam/venv/bin/dcamd
"""
"""Run by sh in a mount namespace of its own: DIRECTORY, deploy/install, BUILDER."""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a mount namespace")
def test_without_systemd_it_installs_and_says_what_is_left_to_do(tmp_path: Path) -> None:
    done = subprocess.run(
        [
            *("unshare", "--mount", "sh", "-c", CONTAINER, "sh"),
            *(str(tmp_path), str(ROOT / "deploy/install"), sys.executable),
        ],
        env={**os.environ, "PYTHON": sys.executable, "SELF_TEST": "no", **OFFLINE},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for said in (
        "installed: dcamd, dcam-ctl and dcam-web in /usr/local/bin",
        "Left to do by hand:",
        "make /etc/dcam/dcam.toml your site's",
        "runuser -u dcam -- env NUMBA_CACHE_DIR=/var/cache/dcam/numba dcamd",
        "every minute: runuser -u dcam -- dcam-ctl alarm",
        "once a day: runuser -u dcam -- dcam-ctl report --monthly",
        "runuser -u dcam -- dcam-web",
        "runuser -u dcam -- dcam-ctl send --follow",
        ":/var/lib/dcam:/usr/sbin/nologin",
        "state: dcam 750",
        "/opt/dcam/venv/bin/dcamd\n",
    ):
        assert said in done.stdout
    assert "not installed" not in done.stderr


def test_make_has_a_target_that_only_makes_the_environment() -> None:
    made = subprocess.run(
        ["make", "--dry-run", "--always-make", "venv"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert "--editable" in made
    assert "pytest" not in made.replace(".pytest_cache", "")
    assert "dcam-ctl demo" not in made
