"""The ways to a GenICam camera: Aravis and harvesters over GigE Vision, Aravis over USB3 Vision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivers.genicam.aravis import AravisCamera
from drivers.genicam.gentl import GentlCamera
from drivers.protocols import Camera, CameraSettings, Role
from tests.drivers.genicam.gentl.bench import genapi_xml, producer
from tests.drivers.genicam.gige.bench import QUIET, SETTINGS
from tests.drivers.genicam.gige.process import CameraProcess
from tests.drivers.genicam.usb3.bench import Usb3Process, require_bus

KindName = Literal["aravis", "harvesters", "usb3"]
KINDS: tuple[KindName, ...] = ("aravis", "harvesters", "usb3")


@dataclass(frozen=True, slots=True)
class Kind:
    """One implementation."""

    name: KindName
    make: Callable[[str, CameraSettings, Role | None], Camera]
    """Of serial number, settings and role."""
    options: tuple[str, ...]
    """What its camera process needs."""
    process_class: type[CameraProcess] = CameraProcess
    settings: CameraSettings = SETTINGS
    """With which to wait takes no processor."""

    def process(
        self, address: str, serial: str, images: Sequence[Path], options: Sequence[str] = ()
    ) -> CameraProcess:
        """A camera process for it."""
        return self.process_class(address, serial, images, [*self.options, *options])


def kind_of(name: KindName) -> Kind:
    """Give an implementation; skips where what it needs is missing."""
    if name == "aravis":
        return Kind(name, AravisCamera, ())
    if name == "usb3":
        require_bus()
        return Kind(name, AravisCamera, (), Usb3Process, QUIET)
    cti = producer()
    return Kind(
        name,
        lambda serial, settings, role: GentlCamera(serial, settings, cti, role),
        ("--xml", str(genapi_xml())),
    )
