"""USB3 Vision cameras as the kernel sees them: who may open them, how fast their link is.

Nothing is opened.
"""

from __future__ import annotations

from collections.abc import Iterator

from daemon.checks import host
from daemon.checks.finding import Finding, unless
from daemon.config.reading import Config
from daemon.errors import ExitCode
from daemon.user_names import group_name
from drivers.genicam.aravis_device import USB_UNDER_WAY, buffers_for
from drivers.genicam.serial_number import as_on_label
from drivers.genicam.usb_bus import APPLY_RULES, UsbCamera, usb_cameras
from drivers.protocols import Role

USB3_MBIT_S = 5000
USUAL_LIMIT_MB = 1000


def check_usb(config: Config) -> Iterator[Finding]:
    """Look at every USB3 Vision camera, and at what the kernel grants all of them together."""
    cameras = usb_cameras(host.ROOT)
    if not cameras:
        return
    yield _memory(config)
    yield _controllers(cameras, config)
    person = host.whoever_runs_dcamd()
    for camera in cameras:
        yield from _camera(camera, _name(camera, config), person)


def _name(camera: UsbCamera, config: Config) -> str:
    roles: tuple[Role, ...] = ("main", "sub")
    for role in roles:
        if camera.has_serial(config.camera.of(role).serial):
            return f"{role} usb"
    return "other usb"


def _memory(config: Config) -> Finding:
    limit_mb = host.number(host.path("sys/module/usbcore/parameters/usbfs_memory_mb"))
    sizes = [frame_bytes(config, role) for role in ("main", "sub")]
    need_mb = sum(min(size * buffers_for(size, on_usb=True), USB_UNDER_WAY) for size in sizes) / 1e6
    if limit_mb is None:
        return Finding("usb memory", "warning", "the kernel does not tell: modprobe usbcore")
    granted = "no limit" if limit_mb == 0 else f"{limit_mb} MB"
    text = f"{granted}, both cameras need {need_mb:.0f} MB"
    cure = (
        f"echo {USUAL_LIMIT_MB} > /sys/module/usbcore/parameters/usbfs_memory_mb;"
        f" to keep it, install 60-dcam.rules and {APPLY_RULES}"
    )
    return unless(limit_mb == 0 or limit_mb >= need_mb, "usb memory", text, cure)


def _controllers(cameras: list[UsbCamera], config: Config) -> Finding:
    """Where each camera is plugged in: a hub or a controller that two share is a first suspect."""
    places = []
    for camera in cameras:
        hubs = camera.port.count(".")
        through = f" behind {hubs} hub{'s' if hubs > 1 else ''}" if hubs else ""
        on = camera.controller() or "an unknown controller"
        places.append(f"{_name(camera, config)} at port {camera.port}{through} of {on}")
    return Finding("usb ports", "ok", "; ".join(places))


def frame_bytes(config: Config, role: str) -> int:
    """Give the size of a camera's image on its way to the computer."""
    camera = config.camera.main if role == "main" else config.camera.sub
    return camera.width_px * camera.height_px * (1 if camera.pixel_format == "Mono8" else 2)


def _camera(camera: UsbCamera, name: str, person: host.Person) -> Iterator[Finding]:
    what = f"{camera.product} {as_on_label(camera.serial)}".strip()
    yield _access(camera, f"{name} access", what, person)
    mbit_s = host.number(camera.attribute("speed"))
    if mbit_s is None:
        yield Finding(f"{name} link", "warning", f"{what}: speed unknown: unplug it and plug it in")
    else:
        cure = "plug it into a USB 3 port (blue or marked SS), with a USB 3 cable of at most 3 m"
        yield unless(mbit_s >= USB3_MBIT_S, f"{name} link", f"{what} at {mbit_s} Mbit/s", cure)
    power = host.text(camera.attribute("power/control"))
    control = camera.attribute("power/control").relative_to(host.ROOT)
    text = "never put to sleep" if power == "on" else "may be put to sleep"
    cure = f"echo on > /{control}; to keep it, install 60-dcam.rules and {APPLY_RULES}"
    yield unless(power in {"on", None}, f"{name} power", text, cure)


def _access(camera: UsbCamera, name: str, what: str, person: host.Person) -> Finding:
    node = camera.node
    try:
        if person.may_use(node):
            return Finding(name, "ok", f"{person.name} may open {what}")
        group = group_name(node.stat().st_gid)
    except OSError:
        text = f"{what}: no {node}: unplug it and plug it in"
        return Finding(name, "error", text, ExitCode.HARDWARE)
    text = (
        f"{person.name} may not open {what} ({node}, group {group}):"
        f" install 60-dcam.rules and {APPLY_RULES}"
    )
    if group == host.SERVICE_USER:
        text = (
            f"{person.name} may not open {what} ({node}): usermod --append --groups {group}"
            f" {person.name} and log in again"
        )
    return Finding(name, "error", text, ExitCode.HARDWARE)
