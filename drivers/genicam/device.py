"""The small face behind which GenICam libraries are alike: one device, its features, its frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from drivers.protocols import CameraSettings, Image

Value = str | bool | int | float

BITS_OF_FORMAT = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono16": 16}
CODE_OF_FORMAT = {
    "Mono8": 0x01080001,
    "Mono10": 0x01100003,
    "Mono12": 0x01100005,
    "Mono16": 0x01100007,
}
"""GigE Vision and USB3 Vision pixel format codes (Pixel Format Naming Convention 2.1)."""

CONTROL_WAIT_S = 5.0
"""A GigE camera forgets a program that died after its heartbeat time-out, 3 s by default."""
POLL_S = 0.25
"""How often a waiting call looks again."""
N_BUFFERS = 4
FOREIGN_ADVICE = (
    "it sends something else than it was set to, as when another program has left chunk data on:"
    " switch it off and on"
)


class NodeRefusedError(Exception):
    """The camera, or its description, declined a value or a command; the connection is sound."""


class NoAnswerError(Exception):
    """The device did not answer, or the library says that it is gone."""


@dataclass(frozen=True, slots=True)
class Grabbed:
    """What came out of the stream, whole or not."""

    frame_id: int | None
    """The camera's own counter; None when the frame was too torn to tell."""
    time_ns: int
    """The camera's own clock; 0 when it tells none."""
    pixels: Image | None
    """(height, width), a copy; None for an incomplete frame."""
    problem: str = ""
    """Why there are no pixels."""
    advice: str | None = None
    """What to do about that; None: what helps where data are missing."""


class Features(Protocol):
    """The features of one open device by their names.

    Each call but `has` raises NodeRefusedError when the device declined, and every call
    NoAnswerError when it did not answer.
    """

    def has(self, name: str) -> bool:
        """Whether the feature is there and can be used now."""
        ...

    def read(self, name: str) -> Value:
        """Give the value, an enumeration's as the name of its entry."""
        ...

    def write(self, name: str, value: Value) -> None:
        """Set the value, whatever its access mode is said to be."""
        ...

    def limits(self, name: str) -> tuple[float, float]:
        """Give the least and the greatest value of a number at present."""
        ...

    def step(self, name: str) -> int:
        """Give the step of an integer."""
        ...

    def choices(self, name: str) -> list[str]:
        """Give the entries of an enumeration that can be chosen now."""
        ...

    def execute(self, name: str) -> None:
        """Carry out a command."""
        ...


class Device(Protocol):
    """One device from finding to release; used in one thread, but `is_lost`.

    Every call raises NoAnswerError when the device does not answer.
    """

    @property
    def features(self) -> Features:
        """Its features, once it is open."""
        ...

    @property
    def listed_serial(self) -> str:
        """Its serial number in the library's list, once it is open: on USB in another spelling."""
        ...

    @property
    def is_lost(self) -> bool:
        """Whether the library has noticed by itself that the device is gone."""
        ...

    @property
    def missing_data_advice(self) -> str:
        """What to look at when data of a frame are missing."""
        ...

    def open(self) -> None:
        """Find the device by serial and become its controller; what runs there is stopped.

        Raises DeviceLostError that says what was found instead, or who has it.
        """
        ...

    def open_stream(self, settings: CameraSettings) -> None:
        """Make ready for frames of the size that is set now."""
        ...

    def start(self) -> None:
        """Start acquisition."""
        ...

    def stop(self) -> None:
        """Stop acquisition."""
        ...

    def pop(self, timeout_s: float) -> Grabbed | None:
        """Give the next frame, or None when none came in time; 0 does not wait."""
        ...

    def release(self) -> None:
        """Give the device back, as far as it answers; after it the object is done."""
        ...
