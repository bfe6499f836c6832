"""A frame set as a whole, and its images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from core.images import GreyImage
from drivers.errors import FrameSetError, ImageMissingError
from drivers.frameset.row import TABLE, FrameRole, FrameSetRow, slots_of_rows
from drivers.frameset.table import FramePath, read_table
from drivers.png import decode_png


@dataclass(frozen=True, slots=True)
class FrameSet:
    """A frame set as its table describes it; the images are read one by one."""

    directory: Path
    rows: tuple[FrameSetRow, ...]

    def rows_of(self, *roles: FrameRole) -> tuple[FrameSetRow, ...]:
        """Give the rows of these roles, in time order."""
        return tuple(row for row in self.rows if row.role in roles)

    def slots_of(self, *roles: FrameRole) -> tuple[tuple[FrameSetRow, ...], ...]:
        """Give the rows of these roles, those of one slot together, in time order."""
        return tuple(slots_of_rows(self.rows_of(*roles)))

    def read(self, name: str) -> GreyImage:
        """Read one image by its name in the table. Raises FrameSetError."""
        return read_image(self.directory / name)


def read_frame_set(directory: Path) -> FrameSet:
    """Read a set's table and check it; missing images are found when they are read.

    Raises FrameSetError: no table, missing column, bad time, unknown role, duplicate slot, two
    references, rows out of order ...; the message names file and line.
    """
    if not directory.is_dir():
        msg = f"{directory}: no such directory; give the directory of a frame set"
        raise FrameSetError(msg)
    return FrameSet(directory, read_table(directory))


def read_image(path: FramePath) -> GreyImage:
    """Read an 8- or 16-bit greyscale PNG, whole and undamaged or not at all.

    Raises FrameSetError (ImageMissingError when the file is not there).
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        msg = f"{path}: not there; restore the image or drop its row from {TABLE}"
        raise ImageMissingError(msg) from None
    except OSError as error:
        msg = f"{path}: cannot be read ({error.strerror}); check the file and its permissions"
        raise FrameSetError(msg) from None
    try:
        return decode_png(data)
    except ValueError as error:
        msg = f"{path}: {error}"
        raise FrameSetError(msg) from None
