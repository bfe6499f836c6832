"""USB3 Vision cameras as the kernel sees them, which is without opening any.

Attributes: Documentation/ABI/testing/sysfs-bus-usb of the kernel; class codes: USB3 Vision 1.1, 4.1
(interface EFh, 05h).
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from drivers.genicam.serial_number import as_on_label, is_same_serial

ROOT = Path("/")
"""Where the kernel's files are; tests make up a computer elsewhere."""
USB3_VISION = ("ef", "05")
FLIR = "1e10"
APPLY_RULES = "udevadm control --reload && udevadm trigger --action=change --subsystem-match=usb"
"""Applies 60-dcam.rules to what is plugged in."""


@dataclass(frozen=True, slots=True)
class UsbCamera:
    """A camera on the bus."""

    directory: Path
    """Of the device, in sys/bus/usb/devices."""
    node: Path
    """What is opened to talk to it."""
    serial: str
    product: str

    def attribute(self, name: str) -> Path:
        """Give the file of an attribute."""
        return self.directory / name

    @property
    def port(self) -> str:
        """Its place on the bus, as `2-1.3`: bus 2, port 3 of the hub at port 1."""
        return self.directory.name

    def controller(self) -> str:
        """What it hangs on, as `xhci_hcd 0000:00:14.0 (8086:a36d)`; empty where nothing tells."""
        for above in self.directory.resolve().parents:
            vendor, device = (_text(above / name) for name in ("vendor", "device"))
            if vendor and device:
                driver = (above / "driver").resolve().name if (above / "driver").exists() else ""
                pci = f"{vendor.removeprefix('0x')}:{device.removeprefix('0x')}"
                return f"{driver} {above.name} ({pci})".strip()
        return ""

    def has_serial(self, serial: str | None) -> bool:
        """Tell whether it is the camera of a config."""
        return serial is not None and is_same_serial(serial, self.serial)


def usb_cameras(root: Path | None = None) -> list[UsbCamera]:
    """List the USB3 Vision cameras that are plugged in."""
    root = root or ROOT
    cameras = []
    for directory in sorted((root / "sys/bus/usb/devices").glob("*")):
        if ":" in directory.name or not (directory / "idVendor").exists():
            continue  # an interface of a device
        if _text(directory / "idVendor") == FLIR or _speaks_usb3_vision(directory):
            bus, device = (_text(directory / name) for name in ("busnum", "devnum"))
            node = root / f"dev/bus/usb/{int(bus or 0):03d}/{int(device or 0):03d}"
            serial, product = _text(directory / "serial"), _text(directory / "product")
            cameras.append(UsbCamera(directory, node, serial, product or "camera"))
    return cameras


def why_not_on_usb(serial: str) -> str | None:
    """Say why a library does not list a camera that is plugged in; None if it is not."""
    for camera in usb_cameras():
        if camera.has_serial(serial) and not os.access(camera.node, os.R_OK | os.W_OK):
            return (
                f"plugged in ({camera.product} {as_on_label(camera.serial)}), but may not be"
                f" opened ({camera.node}): install 60-dcam.rules and {APPLY_RULES}; dcam-ctl"
                " check --hardware says more"
            )
    return None


def _speaks_usb3_vision(device: Path) -> bool:
    names = ("bInterfaceClass", "bInterfaceSubClass")
    return any(
        tuple(_text(interface / name) for name in names) == USB3_VISION
        for interface in device.glob(f"{device.name}:*")
    )


def _text(where: Path) -> str:
    try:
        return where.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
