"""Frame sets: a directory of lossless greyscale PNG images and their table, `frames.csv`.

Whatever is damaged in one gives a `FrameSetError` of one line: what, where, what to do.
"""

from drivers.frameset.frame_set import FrameSet, read_frame_set, read_image
from drivers.frameset.row import (
    BURST,
    COLUMNS,
    HEADER,
    READING,
    TABLE,
    TEMPERATURES,
    FrameRole,
    FrameSetRow,
    format_header,
    format_row,
    format_slot,
    optional_number,
    parse_slot,
    readings_of,
    slots_of_rows,
)
from drivers.frameset.table import FramePath, read_table, write_table
from drivers.png import encode_png

__all__ = [
    "BURST",
    "COLUMNS",
    "HEADER",
    "READING",
    "TABLE",
    "TEMPERATURES",
    "FramePath",
    "FrameRole",
    "FrameSet",
    "FrameSetRow",
    "encode_png",
    "format_header",
    "format_row",
    "format_slot",
    "optional_number",
    "parse_slot",
    "read_frame_set",
    "read_image",
    "read_table",
    "readings_of",
    "slots_of_rows",
    "write_table",
]
