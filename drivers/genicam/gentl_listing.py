"""Which of the devices that a GenTL producer lists is the camera with a serial number.

Producers also list devices of others, which may report no serial number (the standard allows "not
available"), and list one camera once for each network interface or filter driver that leads to it
(harvesters#221, #231).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from drivers.errors import DeviceLostError
from drivers.genicam.serial_number import as_on_label, as_on_usb, places_of

FREE = {None, 0, 1}
"""Access status that lets a device be opened: not reported, unknown, read and write (GenTL 1.5)."""


@dataclass(frozen=True, slots=True)
class Listed:
    """One entry of a producer's list, with whatever the producer reports of it."""

    serial: str
    """Empty when the producer reports none."""
    device_id: str
    model: str
    """Vendor and model."""
    is_free: bool
    info: Any
    """The `DeviceInfo` of `harvesters`, which opens it."""


def read_list(infos: Iterable[Any]) -> list[Listed]:
    """Read what `harvesters` has asked of each device; what it could not have is None there."""
    return [_read(info) for info in infos]


def _read(info: Any) -> Listed:
    said: dict[str, Any] = info.property_dict
    names = (said.get("vendor"), said.get("model"))
    return Listed(
        serial=str(said.get("serial_number") or "").strip(),
        device_id=str(said.get("id_") or ""),
        model=" ".join(str(name) for name in names if name),
        is_free=said.get("access_status") in FREE,
        info=info,
    )


def find_entries(serial: str, listed: list[Listed], producer: str) -> list[Listed]:
    """Give the entries of the camera, those that can be opened first, each device id once.

    Raises DeviceLostError when there is none, or when they are of different cameras.
    """
    by_id: dict[str, Listed] = {}
    for i in places_of(serial, [entry.serial for entry in listed]):
        by_id.setdefault(listed[i].device_id, listed[i])
    entries = sorted(by_id.values(), key=lambda entry: not entry.is_free)
    models = {entry.model for entry in entries}
    if len(models) > 1:
        msg = (
            f"camera {serial}: {producer} finds {len(models)} cameras with this serial number, of"
            f" different models ({', '.join(sorted(models))}); disconnect those that are not dcam's"
        )
        raise DeviceLostError(msg)
    if entries:
        return entries
    msg = (
        f"camera {as_on_usb(serial)}: not found; {producer} finds {_names(listed)}. Check power,"
        " cable and the serial number in the config"
    )
    raise DeviceLostError(msg)


def _names(listed: list[Listed]) -> str:
    named = sorted({entry.serial for entry in listed if entry.serial})
    unnamed = sorted({entry.model or entry.device_id for entry in listed if not entry.serial})
    names = [
        *map(as_on_label, named),
        *(f"{name} (which reports no serial number)" for name in unnamed),
    ]
    return ", ".join(names) or "no camera at all"
