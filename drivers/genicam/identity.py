"""What a camera says of itself, for the log and for whoever reads a report from afar."""

from __future__ import annotations

from drivers.genicam.device import Features, NodeRefusedError

NAMES = (
    *("DeviceVendorName", "DeviceModelName", "DeviceVersion", "DeviceFirmwareVersion"),
    *("DeviceSerialNumber", "DeviceID"),
)
"""Of SFNC; DeviceID is the serial number's older name."""


def read_identity(features: Features) -> dict[str, str]:
    """Read those that there are. Raises NoAnswerError."""
    said = {}
    for name in NAMES:
        try:
            if features.has(name):
                said[name] = str(features.read(name)).strip()
        except NodeRefusedError:
            continue  # this one it does not tell
    return said
