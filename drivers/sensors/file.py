"""A sensor that the kernel shows as a file: hwmon, iio, 1-wire."""

from __future__ import annotations

from pathlib import Path

from drivers.errors import SensorError
from drivers.sensors.number import parse_number

_MOST_BYTES = 4096


class FileSensor:
    """Reads one file; implements `Sensor`. A read that the kernel does not end hangs.

    A `*` in the path stands for what the kernel counts otherwise at another start: `hwmon*`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    @property
    def bus(self) -> str:
        """The file: nothing else is waited for."""
        return str(self._path)

    def read(self, timeout_s: float) -> float:  # noqa: ARG002 - the kernel knows no deadline
        """Give the file's number. Raises SensorError."""
        try:
            with self._found().open("rb", buffering=0) as file:
                data = file.read(_MOST_BYTES) or b""
        except OSError as error:
            msg = f"{self._path}: cannot be read ({error.strerror})"
            raise SensorError(msg) from None
        try:
            return parse_number(data.decode("utf-8", "replace"))
        except SensorError as error:
            msg = f"{self._path}: {error}"
            raise SensorError(msg) from None

    def _found(self) -> Path:
        """The file that the path means. Raises SensorError where it means several or none."""
        if "*" not in str(self._path):
            return self._path
        root = Path(self._path.anchor)
        found = list(root.glob(str(self._path.relative_to(root))))
        if len(found) != 1:
            msg = f"{self._path}: {len(found) or 'no'} such files, not one"
            raise SensorError(msg)
        return found[0]

    def stop(self) -> None:
        """Do nothing: a read cannot be cut off."""
