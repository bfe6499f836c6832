"""The systemd unit is one that systemd accepts, well locked in, with what the daemon relies on."""

import configparser
import shutil
import subprocess
from pathlib import Path

import pytest

from daemon.clock.machine import BOOT_ID_VARIABLE
from daemon.config.reading import DEFAULT_STATE_DIRECTORY
from daemon.control.run_state import RUNTIME_DIRECTORY
from daemon.errors import ExitCode
from daemon.loop_cache import SHARED
from daemon.slots.reporting import MARGIN_S

USAGE, CONFIG = ExitCode.USAGE, ExitCode.CONFIG
ROOTS = ("/var/lib", "/run", "/var/cache")
UNITS = Path(__file__).parents[3] / "systemd"
UNIT = UNITS / "dcamd.service"

TIMER = "dcam-alarm.timer"

needs_systemd = pytest.mark.skipif(
    not shutil.which("systemd-analyze"), reason="systemd-analyze is not installed"
)


def section(name: str) -> configparser.SectionProxy:
    """A section of the unit; of a key that stands there more than once, the last."""
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(UNIT)
    return parser[name]


def service() -> configparser.SectionProxy:
    return section("Service")


@needs_systemd
def test_systemd_has_nothing_to_say_against_the_units(tmp_path: Path) -> None:
    """The installed programs are not here: stand-ins take their places, nothing else is changed."""
    installed = Path(service()["ExecStart"]).parent
    for program in ("dcamd", "dcam-ctl", "dcam-web"):
        stand_in = tmp_path / program
        stand_in.write_text("#!/bin/sh\n")
        stand_in.chmod(0o755)
    units = [
        tmp_path / name
        for name in (
            *("dcamd.service", "dcam-alarm.service", TIMER, "dcam-send.service"),
            *("dcam-sync.service", "dcam-sync.timer"),
            *("dcam-archive.service", "dcam-archive.timer"),
            "dcam-web.service",
        )
    ]
    for unit in units:
        text = (UNITS / unit.name).read_text()
        for place in (f"{installed}/", "/opt/dcam-archive/bin/"):
            text = text.replace(place, f"{tmp_path}/")
        unit.write_text(text)

    result = subprocess.run(
        ["systemd-analyze", "verify", *map(str, units)], capture_output=True, text=True, check=False
    )

    complaints = [line for line in result.stderr.splitlines() if "dcam" in line]
    assert (result.returncode, complaints) == (0, [])


@needs_systemd
@pytest.mark.parametrize(
    "name",
    ["dcamd", "dcam-alarm", "dcam-archive", "dcam-send", "dcam-sync", "dcam-web"],
)
def test_systemd_rates_the_unit_as_locked_in(name: str) -> None:
    """At most 1.5 of 10; more would be reachable than two cameras, a serial port and its files."""
    result = subprocess.run(
        [
            "systemd-analyze",
            "security",
            "--offline=true",
            "--threshold=15",
            str(UNITS / f"{name}.service"),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize("name", ["alarm", "archive", "report", "send", "sync", "web"])
def test_on_a_busy_computer_dcamd_has_many_times_the_processor_of_its_helpers(name: str) -> None:
    """By the weight of their groups: Nice does not count between two services."""
    assert int(service()["CPUWeight"]) >= 300
    helper = (UNITS / f"dcam-{name}.service").read_text()
    assert "\nCPUWeight=10\n" in helper


def test_devices_and_compiler_are_not_locked_out() -> None:
    text = UNIT.read_text()
    for device in ("usb_device", "ttyUSB", "ttyACM", "ttyS"):
        assert f"\nDeviceAllow=char-{device} rw\n" in text
    families = set(service()["RestrictAddressFamilies"].split())
    assert {"AF_INET", "AF_NETLINK", "AF_UNIX"} <= families
    for closed in ("PrivateDevices", "PrivateNetwork", "MemoryDenyWriteExecute", "ProcSubset"):
        assert closed not in service()


def test_service_comes_back_always_and_for_ever() -> None:
    unit = service()
    assert int(unit["WatchdogSec"]) == 3 * 60 + MARGIN_S
    assert unit["Restart"] == "always"
    assert section("Unit")["StartLimitIntervalSec"] == "0"
    assert unit["RestartPreventExitStatus"].split() == [str(USAGE.value), str(CONFIG.value)]


def test_unit_says_what_the_daemon_relies_on() -> None:
    unit = service()
    assert unit["Type"] == "notify"
    assert unit["User"] == "dcam"
    directories = (unit["StateDirectory"], unit["RuntimeDirectory"], unit["CacheDirectory"])
    assert tuple(Path(root) / name for root, name in zip(ROOTS, directories, strict=True)) == (
        DEFAULT_STATE_DIRECTORY,
        RUNTIME_DIRECTORY,
        SHARED,
    )
    assert unit["ExecStart"] == "/opt/dcam/venv/bin/dcamd"
    assert f"\nEnvironment={BOOT_ID_VARIABLE}=%b\n" in UNIT.read_text()
