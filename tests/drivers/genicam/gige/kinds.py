"""The implementations of a GenICam camera, each over the same camera processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivers.genicam.aravis import AravisCamera
from drivers.genicam.gentl import GentlCamera
from drivers.protocols import Camera, CameraSettings, Role
from tests.drivers.genicam.gentl.bench import genapi_xml, producer
from tests.drivers.genicam.gige.process import CameraProcess

KindName = Literal["aravis", "harvesters"]
KINDS: tuple[KindName, ...] = ("aravis", "harvesters")


@dataclass(frozen=True, slots=True)
class Kind:
    """One implementation."""

    name: KindName
    make: Callable[[str, CameraSettings, Role | None], Camera]
    """Of serial number, settings and role."""
    options: tuple[str, ...]
    """What its camera process needs."""

    def process(
        self, address: str, serial: str, images: Sequence[Path], options: Sequence[str] = ()
    ) -> CameraProcess:
        """A camera process for it."""
        return CameraProcess(address, serial, images, [*self.options, *options])


def kind_of(name: KindName) -> Kind:
    """Give an implementation; skips where what it needs is missing."""
    if name == "aravis":
        return Kind(name, AravisCamera, ())
    cti = producer()
    return Kind(
        name,
        lambda serial, settings, role: GentlCamera(serial, settings, cti, role),
        ("--xml", str(genapi_xml())),
    )
