"""`check --hardware` on made-up computers: each thing that is wrong is named with its cure."""

from __future__ import annotations

import json
import os
import pwd
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from daemon.checks import devices, host
from drivers.errors import DeviceLostError
from drivers.protocols import Camera, CameraSettings, Role
from tests.daemon.commands.conftest import CONFIG, SIMULATED, Ctl

REAL = CONFIG.replace("width_px", 'backend = "aravis"\nserial = "SERIAL"\nwidth_px').replace(
    "SERIAL", "15290000", 1
)
NOW_S = 1772323200.0  # 2026-03-01
ROUTES = """\
Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT
eth0\t00000000\t010AA8C0\t0003\t0\t0\t0\t00000000\t0\t0\t0
eth0\t000AA8C0\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0
eth1\t000010AC\t00000000\t0001\t0\t0\t0\t0000FFFF\t0\t0\t0
"""
"""As /proc/net/route: default by eth0, 192.168.10.0/24 on it, 172.16.0.0/16 on eth1."""


@dataclass(frozen=True)
class Computer:
    """Files of a kernel that is not there; at first one without anything wrong."""

    root: Path

    def says(self, name: str, text: object) -> None:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")

    def plug_in(self, name: str, serial: str, *, device: int, vendor: str = "1e10") -> str:
        """A USB3 Vision camera on bus 2; gives the folder of its attributes."""
        folder = f"sys/bus/usb/devices/{name}"
        for attribute, value in (
            ("idVendor", vendor),
            ("product", "Grasshopper3"),
            ("serial", serial),
            ("speed", 5000),
            ("busnum", 2),
            ("devnum", device),
            ("power/control", "on"),
            (f"{name}:1.0/bInterfaceClass", "ef"),
            (f"{name}:1.0/bInterfaceSubClass", "05"),
        ):
            self.says(f"{folder}/{attribute}", value)
        self.says(f"dev/bus/usb/002/{device:03d}", "")
        return folder


@pytest.fixture
def computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Computer:
    computer = Computer(tmp_path / "root")
    monkeypatch.setattr(host, "ROOT", computer.root)
    found_at(monkeypatch)
    computer.says("sys/module/usbcore/parameters/usbfs_memory_mb", 1000)
    computer.says("sys/class/thermal/thermal_zone0/type", "x86_pkg_temp")
    computer.says("sys/class/thermal/thermal_zone0/temp", 52000)
    computer.says("sys/class/thermal/thermal_zone0/trip_point_0_type", "critical")
    computer.says("sys/class/thermal/thermal_zone0/trip_point_0_temp", 100000)
    computer.says("sys/class/watchdog/watchdog0/identity", "iTCO_wdt")
    computer.says("sys/class/watchdog/watchdog0/state", "active")
    monkeypatch.setattr("daemon.checks.computer.time", SimpleNamespace(time=lambda: NOW_S))
    computer.says("sys/class/rtc/rtc0/since_epoch", int(NOW_S))
    computer.says("etc/systemd/system/dcamd.service", "")
    computer.says("etc/systemd/system/multi-user.target.wants/dcamd.service", "")
    computer.says("proc/net/route", ROUTES.rstrip())
    computer.says("proc/sys/net/core/rmem_max", 33554432)
    for name in ("eth0", "eth1"):
        computer.says(f"sys/class/net/{name}/speed", 1000)
        computer.says(f"sys/class/net/{name}/mtu", 9000)
    return computer


Findings = dict[str, tuple[str, str]]


@pytest.fixture
def check(ctl: Ctl, tmp_path: Path):
    """`check --hardware --json` of a config; gives the exit code and (state, text) by name."""

    def ran(config: str) -> tuple[int, Findings]:
        (tmp_path / "dcam.toml").write_text(config)
        words = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
        done = ctl(*words, "check", "--hardware", "--json")
        found = json.loads(done.out)["findings"]
        return done.code, {f["name"]: (f["state"], f["text"]) for f in found}

    return ran


def real(sub: str = "15290001") -> str:
    """A site with two cameras of Aravis, which are not there."""
    return REAL.replace("SERIAL", sub)


def test_nothing_is_wrong_with_a_computer_in_order(check, computer: Computer) -> None:
    code, found = check(SIMULATED)
    assert code == 0
    for name in ("user", "disk speed", "computer", "watchdog", "battery clock", "service"):
        assert found[name][0] == "ok", found[name]
    assert "52 °C, its limit is 100 °C" in found["computer"][1]
    assert "main heat" in found
    assert not [name for name in found if "usb" in name or "link" in name]


@pytest.mark.parametrize(
    ("file", "says", "name", "cure"),
    [
        ("sys/class/thermal/thermal_zone0/temp", 95000, "computer", "give the cabinet air"),
        ("sys/class/watchdog/watchdog0/state", "inactive", "watchdog", "RuntimeWatchdogSec"),
        ("sys/class/rtc/rtc0/since_epoch", 0, "battery clock", "hwclock --systohc"),
    ],
)
def test_what_is_wrong_with_the_computer_is_reported_with_its_cure(
    check, computer: Computer, file: str, says: object, name: str, cure: str
) -> None:
    computer.says(file, says)
    _, found = check(SIMULATED)
    assert found[name][0] == "warning"
    assert cure in found[name][1]


def test_a_service_that_does_not_start_with_the_computer(check, computer: Computer) -> None:
    (computer.root / "etc/systemd/system/multi-user.target.wants/dcamd.service").unlink()
    _, found = check(SIMULATED)
    assert found["service"] == (
        "warning",
        "does not start with the computer: systemctl enable dcamd",
    )


def test_usb_cameras_in_order(check, computer: Computer) -> None:
    """The one names itself in decimal, the other in hexadecimal, as FLIR's do."""
    computer.plug_in("2-1", "15290000", device=3)
    computer.plug_in("2-2", "00E94E91", device=4)
    _, found = check(real())
    for role in ("main", "sub"):
        for what in ("access", "link", "power"):
            assert found[f"{role} usb {what}"][0] == "ok", found
    assert found["main usb link"][1] == "Grasshopper3 15290000 at 5000 Mbit/s"
    assert found["usb memory"][0] == "ok"


def test_where_usb_cameras_are_plugged_in_is_reported(check, computer: Computer) -> None:
    """As the kernel has it: the bus lists links into the tree of devices."""
    controller = "sys/devices/pci0000:00/0000:00:14.0"
    computer.says(f"{controller}/vendor", "0x8086")
    computer.says(f"{controller}/device", "0xa36d")
    driver = computer.root / "sys/bus/pci/drivers/xhci_hcd"
    driver.mkdir(parents=True)
    (computer.root / controller / "driver").symlink_to(driver)
    for name, serial, device in (("2-1.3", "15290000", 3), ("2-2", "00E94E91", 4)):
        listed = computer.root / computer.plug_in(name, serial, device=device)
        real_place = computer.root / controller / "usb2" / name
        real_place.parent.mkdir(exist_ok=True)
        listed.rename(real_place)
        listed.symlink_to(real_place)
    _, found = check(real())
    on = "xhci_hcd 0000:00:14.0 (8086:a36d)"
    assert found["usb ports"] == (
        "ok",
        f"main usb at port 2-1.3 behind 1 hub of {on}; sub usb at port 2-2 of {on}",
    )


def test_usb_memory_of_the_kernel_is_too_small_for_two_cameras(check, computer: Computer) -> None:
    """640 x 400 px are small; 16 MB are too few for full-size images, and 0 is no limit."""
    full = real().replace("width_px = 640\nheight_px = 400", "width_px = 1920\nheight_px = 1200")
    computer.plug_in("2-1", "15290000", device=3)
    memory = "sys/module/usbcore/parameters/usbfs_memory_mb"
    for limit_mb, state in ((16, "warning"), (19, "ok"), (0, "ok")):
        computer.says(memory, limit_mb)
        assert check(full)[1]["usb memory"][0] == state
    computer.says(memory, 16)
    text = check(full)[1]["usb memory"][1]
    assert "16 MB, both cameras need 17 MB" in text
    assert "echo 1000 > /sys/module/usbcore/parameters/usbfs_memory_mb" in text


@pytest.mark.parametrize(
    ("attribute", "says", "name", "cure"),
    [
        ("speed", 480, "main usb link", "plug it into a USB 3 port"),
        ("power/control", "auto", "main usb power", "echo on > /sys/bus/usb/devices/2-1/power"),
    ],
)
def test_what_is_wrong_with_a_usb_camera_is_reported_with_its_cure(
    check, computer: Computer, attribute: str, says: object, name: str, cure: str
) -> None:
    folder = computer.plug_in("2-1", "15290000", device=3)
    computer.says(f"{folder}/{attribute}", says)
    _, found = check(real())
    assert found[name][0] == "warning"
    assert cure in found[name][1]


def test_any_makers_usb3_vision_camera_counts_and_nothing_else(check, computer: Computer) -> None:
    computer.plug_in("2-1", "777", device=3, vendor="2676")
    mouse = computer.plug_in("2-2", "", device=4, vendor="046d")
    computer.says(f"{mouse}/2-2:1.0/bInterfaceClass", "03")
    _, found = check(real())
    assert found["other usb link"][1] == "Grasshopper3 777 at 5000 Mbit/s"
    assert len([name for name in found if name.endswith("usb link")]) == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a device to somebody else")
def test_a_camera_that_the_service_may_not_open_is_an_error(
    check, computer: Computer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root asks, and could open anything: what counts is who runs dcamd."""
    monkeypatch.setattr(host, "SERVICE_USER", "nobody")
    gid = pwd.getpwnam("nobody").pw_gid
    computer.plug_in("2-1", "15290000", device=3)
    node = computer.root / "dev/bus/usb/002/003"
    node.chmod(0o664)
    code, found = check(real())
    assert code == 4
    state, text = found["main usb access"]
    assert state == "error"
    assert text.startswith("nobody may not open Grasshopper3 15290000")
    assert "60-dcam.rules" in text
    os.chown(node, 0, gid)
    _, found = check(real())
    assert found["main usb access"] == ("ok", "nobody may open Grasshopper3 15290000")
    assert found["user"][0] == "warning"
    assert "runuser -u nobody -- dcam-ctl check --hardware" in found["user"][1]


def found_at(monkeypatch: pytest.MonkeyPatch, **addresses: str) -> None:
    """As if cameras had answered Aravis on the network, and could then not be opened."""

    def gone(_serial: str, _settings: CameraSettings, _role: Role) -> Camera:
        msg = "gone again"
        raise DeviceLostError(msg)

    monkeypatch.setattr(devices, "found_on_network", lambda _config: addresses)
    monkeypatch.setattr("drivers.genicam.aravis.AravisCamera", gone)
    monkeypatch.setattr("drivers.genicam.aravis_device.load_aravis", lambda: None)


def test_gige_cameras_in_order(check, computer: Computer, monkeypatch: pytest.MonkeyPatch) -> None:
    found_at(monkeypatch, main="192.168.10.7", sub="172.16.3.4")
    _, found = check(real())
    assert found["main link"] == ("ok", "192.168.10.7 through eth0, 1000 Mbit/s")
    assert found["sub link"] == ("ok", "172.16.3.4 through eth1, 1000 Mbit/s")
    assert found["main packets"][0] == found["sub packets"][0] == "ok"
    assert found["receive buffer"][0] == "ok"


@pytest.mark.parametrize(
    ("file", "says", "name", "cure"),
    [
        ("sys/class/net/eth1/speed", 100, "sub link", "ethtool eth1"),
        ("sys/class/net/eth1/mtu", 1500, "sub packets", "ip link set dev eth1 mtu 9000"),
        ("proc/sys/net/core/rmem_max", 212992, "receive buffer", "sysctl net.core.rmem_max="),
        ("proc/net/route", "Iface", "sub link", "give an interface an address"),
    ],
)
def test_what_is_wrong_with_the_network_is_reported_with_its_cure(
    check,
    computer: Computer,
    monkeypatch: pytest.MonkeyPatch,
    file: str,
    says: object,
    name: str,
    cure: str,
) -> None:
    found_at(monkeypatch, sub="172.16.3.4")
    computer.says(file, says)
    _, found = check(real())
    assert found[name][0] == "warning"
    assert cure in found[name][1]


def test_a_disk_too_slow_for_the_period_is_reported(
    check, computer: Computer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each look at the clock comes a second later, so that a pair takes one."""
    now_s = iter(range(1000))
    monkeypatch.setattr("daemon.checks.disk.monotonic", lambda: next(now_s))
    assert check(SIMULATED)[1]["disk speed"][0] == "ok"
    state, text = check(f"{SIMULATED}\n[schedule]\nperiod_s = 5\n")[1]["disk speed"]
    assert state == "warning"
    assert "1 s to store a slot's frames for good, of 5 s: an SSD" in text


def test_room_is_held_against_the_retention(
    check, computer: Computer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A slot has 0.512 MB; 2 days of 1440, 8 of 24 and 355 of one are 3427 of them: 1.75 GB."""
    retention = f"{SIMULATED}\n[retention]\nevery_slot_days = 2\nhourly_days = 10\n"
    for free_gb, state in ((6.7, "warning"), (6.8, "ok")):
        usage = SimpleNamespace(total=10**12, used=0, free=int(free_gb * 1e9))
        monkeypatch.setattr("daemon.checks.disk.shutil.disk_usage", lambda _path, u=usage: u)
        found = check(f"{retention}min_free_gb = 5.0\n")[1]["disk"]
        assert found[0] == state
        assert "[retention] keeps at most 1.75 GB" in found[1]
    assert check(f"{retention}frames_days = 1\n")[1]["disk"][1].endswith("at most 737 MB")
    assert check(f"{retention}frames_max_gb = 0.5\n")[1]["disk"][1].endswith("at most 500 MB")


def test_trying_the_disk_leaves_nothing_behind(check, computer: Computer, tmp_path: Path) -> None:
    check(SIMULATED)
    assert [path.name for path in (tmp_path / "state").iterdir()] == ["dcamd.lock"]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be refused as root")
def test_root_leaves_another_users_state_alone(ctl: Ctl, tmp_path: Path) -> None:
    """What root wrote there, its owner's dcamd could not write to any more."""
    (tmp_path / "dcam.toml").write_text(SIMULATED)
    state = tmp_path / "state"
    state.mkdir()
    os.chown(state, pwd.getpwnam("nobody").pw_uid, -1)
    for words in (("check", "--hardware"), ("capture",), ("calibrate", "--pan-tilt")):
        done = ctl("--config", tmp_path / "dcam.toml", "--state", state, *words)
        assert done.code == 4
        assert "runuser -u nobody -- dcam-ctl" in done.out + done.err
    assert list(state.iterdir()) == []


# ------------------------------------------------------------ who else is at the head's port

WITH_HEAD = CONFIG + '\n[pan_tilt]\nbackend = "ptu"\nport = "PORT"\n'
MODEM_MANAGER, BRLTTY = "proc/412/comm", "proc/977/comm"


@pytest.mark.parametrize(
    ("file", "name", "cure"),
    [
        (MODEM_MANAGER, "ModemManager", "systemctl disable --now ModemManager"),
        (BRLTTY, "brltty", "apt-get remove brltty"),
    ],
)
def test_a_program_that_may_seize_the_heads_port_is_named(
    check, computer: Computer, file: str, name: str, cure: str
) -> None:
    computer.says(file, name)
    _, found = check(WITH_HEAD.replace("PORT", "/dev/ttyUSB7"))
    state, text = found["head port"]
    assert state == "warning"
    assert cure in text


def test_modem_manager_is_no_rival_where_udev_tells_it_to_leave_the_port_alone(
    check, computer: Computer
) -> None:
    number = Path("/dev/null").stat().st_rdev
    computer.says(MODEM_MANAGER, "ModemManager")
    computer.says(
        f"run/udev/data/c{os.major(number)}:{os.minor(number)}", "G:x\nE:ID_MM_DEVICE_IGNORE=1"
    )
    _, found = check(WITH_HEAD.replace("PORT", "/dev/null"))
    assert found["head port"][0] == "ok"


def test_a_head_behind_the_network_has_no_rivals_here(check, computer: Computer) -> None:
    computer.says(MODEM_MANAGER, "ModemManager")
    _, found = check(WITH_HEAD.replace("PORT", "socket://127.0.0.1:1"))
    assert "head port" not in found
    state, text = found["head"]
    assert state == "error"
    assert "refuses the connection" in text
