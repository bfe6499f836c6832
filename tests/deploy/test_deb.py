"""`make deb`: what the package holds, and what an upgrade with dpkg does to a running dcamd.

Our own package only (`--no-deps`): what is installed beside it is pip's business.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.deploy.scripts import MANUAL, deploy, documents_of_units, man_python, wheel
from tests.exhaustive import one_of

CONTACT = {"DEBFULLNAME": "A Builder", "DEBEMAIL": "builder@bridges.org"}
needs_debian = pytest.mark.skipif(
    not (shutil.which("dpkg-deb") and shutil.which("help2man")),
    reason="dpkg-deb or help2man is not installed",
)


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Debian package; not to be changed."""
    directory = tmp_path_factory.mktemp("package")
    ready = {"WHEEL": wheel(tmp_path_factory), "MAN_PYTHON": man_python(directory)}
    done = deploy("make-deb", sys.executable, directory, **ready, **CONTACT)
    assert done.returncode == 0, done.stderr
    (package,) = directory.glob("dcam_*.deb")
    return package


def ask(*words: object) -> str:
    return subprocess.run(
        ["dpkg-deb", *map(str, words)], check=True, capture_output=True, text=True
    ).stdout


@needs_debian
def test_debian_package_holds_it_all(package: Path, tmp_path: Path) -> None:
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    depends = ask("--field", package, "Depends").strip().split(", ")
    aravis = "gir1.2-aravis-0.8 | gir1.2-aravis-0.10"
    assert {f"python3 (>= {python})", "python3-gi", aravis} <= set(depends)
    assert ask("--field", package, "Maintainer").strip() == "A Builder <builder@bridges.org>"
    files = {}
    for line in ask("--contents", package).splitlines():
        mode, owner, _size, _day, _hour, name, *_target = line.split()
        assert owner == "root/root"
        files[name.removeprefix(".")] = mode
    assert files["/usr/lib/dcam/venv/bin/dcamd"] == "-rwxr-xr-x"
    assert files["/usr/bin/dcam-ctl"].startswith("l")
    units = ("dcamd.service", "dcam-alarm.service", "dcam-alarm.timer")
    units += ("dcam-archive.service", "dcam-archive.timer")
    units += ("dcam-report.service", "dcam-report.timer", "dcam-send.service")
    units += ("dcam-sync.service", "dcam-sync.timer", "dcam-web.service")
    for name in (
        *(f"lib/systemd/system/{unit}" for unit in units),
        "lib/udev/rules.d/60-dcam.rules",
        *(f"lib/dcam/{script}" for script in ("live", "self-test", "rename-venv", "take-over")),
        *(*MANUAL, "share/zsh/vendor-completions/_dcam-ctl"),
        *("share/fish/vendor_completions.d/dcamd.fish", "share/bash-completion/completions/dcamd"),
    ):
        assert f"/usr/{name}" in files
    assert not [name for name in files if not name.startswith("/usr/") and name != "/"]
    ask("--extract", package, tmp_path)
    documents = documents_of_units(tmp_path, "usr/lib/systemd/system")
    assert len(documents) == len(units)
    assert [path for path in documents if not path.is_file()] == []
    ask("--control", package, tmp_path / "control")
    for script in ("preinst", "postinst", "prerm", "postrm"):
        subprocess.run(["sh", "-n", str(tmp_path / "control" / script)], check=True)


@needs_debian
@pytest.mark.skipif(not shutil.which("lintian"), reason="lintian is not installed")
def test_lintian_finds_no_error_and_no_warning_in_the_package(
    package: Path, tmp_path: Path
) -> None:
    """Of the part that is ours: the wheels of others are not in this one.

    It looks at each file for itself, and of our modules, which are alike, at some.
    """
    ask("--raw-extract", package, tmp_path / "tree")
    modules = sorted((tmp_path / "tree/usr/lib/dcam/venv/lib").rglob("[a-z]*.py"))
    kept = set(modules[:: one_of(8)])
    for module in modules:
        if module not in kept:
            module.unlink()
    some = tmp_path / package.name
    ask("--root-owner-group", "-Zgzip", "-z1", "--build", tmp_path / "tree", some)
    checked = subprocess.run(
        ["lintian", "--allow-root", str(some)], capture_output=True, text=True, check=False
    )
    assert checked.stdout == ""


INSTALLED = """
set -eu
mount -t tmpfs tmpfs "$1"
for place in etc opt usr var run; do
  mkdir -p "$1/up/$place" "$1/work/$place"
  mount -t overlay overlay "/$place" \
    -o "lowerdir=/$place,upperdir=$1/up/$place,workdir=$1/work/$place"
done
rm -rf /run/systemd
printf '#!/bin/sh\\nexit 0\\n' > "$1/nothing"  # the package has no libraries beside it to try
chmod +x "$1/nothing"
dpkg-deb --extract "$2" "$1/new"
cp "$1/nothing" "$1/new/usr/lib/dcam/self-test"
modules="$1/new/usr/lib/dcam/venv/loaded-modules"  # byte code is made of each
grep "/daemon/m" "$modules" > "$1/few"
cp "$1/few" "$modules"
dpkg-deb --control "$2" "$1/new/DEBIAN"
sed -i -e '/^Depends/d' -e 's/^Version: .*/Version: 1/' "$1/new/DEBIAN/control"
dpkg-deb -Znone --build "$1/new" "$1/1.deb" > /dev/null
sed -i 's/^Version: .*/Version: 2/' "$1/new/DEBIAN/control"
dpkg-deb -Znone --build "$1/new" "$1/2.deb" > /dev/null
mkdir -p "$1/bin"
PATH="$1/bin:$PATH"
dpkg() { command dpkg --force-unsafe-io --no-triggers "$@"; }
dpkg --install "$1/1.deb" > "$1/log" 2>&1 || { cat "$1/log"; exit 1; }
stat -c "config: %U:%G %a" /etc/dcam/dcam.toml
before=$(readlink -f /opt/dcam/venv)
head -1 "$before/bin/dcamd"
mkdir -p /run/systemd/system
cat > "$1/bin/systemctl" <<EOF
#!/bin/sh
echo "\\$*" >> "$1/asked"
case "\\$*" in
  "is-active dcamd") echo active ;;
  "restart dcamd")
    ls -d $before/bin/dcamd >> "$1/asked"
    readlink -f /opt/dcam/venv >> "$1/asked"
    [ ! -e "$1/refuse" ] || { rm "$1/refuse"; exit 1; } ;;
esac
EOF
chmod +x "$1/bin/systemctl"
ln -sf "$1/nothing" "$1/bin/deb-systemd-invoke"
ln -sf "$1/nothing" "$1/bin/udevadm"
dpkg --install "$1/2.deb" >> "$1/log" 2>&1 || { cat "$1/log"; exit 1; }
echo "asked of systemd:"
grep -v daemon-reload "$1/asked"
at_work=$(readlink -f /opt/dcam/venv)
: > "$1/refuse"
dpkg --install "$1/2.deb" >> "$1/log" 2>&1 && echo "installed what does not start"
[ "$(readlink -f /opt/dcam/venv)" = "$at_work" ] && echo "back to what was there"
dpkg --remove dcam >> "$1/log" 2>&1
ls /opt/dcam 2> /dev/null || echo "nothing left in /opt"
"""
"""Run by sh in a mount namespace of its own: DIRECTORY, package. Its systemd only listens."""


@needs_debian
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a mount namespace")
def test_an_upgrade_stops_dcamd_only_to_start_the_new_one(package: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-c", INSTALLED, "sh", str(tmp_path), str(package)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "config: root:dcam 640"
    before = lines[1].removeprefix("#!").removesuffix("/bin/python3")
    assert before.startswith("/opt/dcam/releases/1-")
    asked = lines[lines.index("asked of systemd:") + 1 :]
    # The one at work has all its files until the new one is asked for, in one step.
    assert asked[:3] == ["is-active dcamd", "restart dcamd", f"{before}/bin/dcamd"]
    assert asked[3].startswith("/opt/dcam/releases/2-")
    assert asked[4:] == ["back to what was there", "nothing left in /opt"]
