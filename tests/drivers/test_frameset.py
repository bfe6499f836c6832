"""Frame sets: what is whole is read to the last bit; whatever is damaged is named in one line."""

from __future__ import annotations

import struct
import zlib
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.errors import FrameSetError, ImageMissingError
from drivers.frameset import (
    COLUMNS,
    HEADER,
    FrameSetRow,
    encode_png,
    format_header,
    format_row,
    format_slot,
    parse_slot,
    read_frame_set,
    read_image,
    write_table,
)

ROWS = (
    "2026-03-01T00:00:00Z,intrinsics,,0000_sub.png,,",
    "2026-03-01T00:01:00Z,reference,0001_main.png,0001_sub.png,0.0,0.0",
    "2026-03-01T00:02:00Z,rig,0002_main.png,0002_sub.png,0.1358,-0.0433",
    "2026-03-01T00:03:00Z,measure,0003_main.png,0003_sub.png,,",
)


def _table(directory: Path, *rows: str, header: str = HEADER) -> Path:
    (directory / "frames.csv").write_text("\n".join((header, *rows)) + "\n")
    return directory


def _noise(dtype: type, shape: tuple[int, int] = (60, 80)) -> np.ndarray:
    top = np.iinfo(dtype).max
    return np.random.default_rng(1).integers(0, top, shape, dtype, endpoint=True)


# ---------------------------------------------------------------------------------- the table


def _burst(*cells: tuple[int, str, str]) -> list[str]:
    """Rows by minute, role and number."""
    return [
        f"2026-03-01T00:{minute:02d}:00Z,{role},{k}_main.png,{k}_sub.png,,,{number}"
        for k, (minute, role, number) in enumerate(cells)
    ]


def test_pairs_of_a_slot_are_numbered(tmp_path: Path) -> None:
    """The optional column `burst` lets one slot have several rows; without a number it is 1."""
    rows = _burst((0, "reference", "1"), (0, "reference", "2"), (1, "measure", ""))
    rows += _burst((2, "measure", "1"), (2, "measure", "3"))
    frames = read_frame_set(_table(tmp_path, *rows, header=f"{HEADER},burst"))
    assert [row.burst for row in frames.rows] == [1, 2, 1, 1, 3]
    assert [len(rows) for rows in frames.slots_of("measure")] == [1, 2]
    assert [len(rows) for rows in frames.slots_of("reference", "measure")] == [2, 1, 2]


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (
            [(0, "measure", "1"), (0, "measure", "1")],
            r"frames\.csv:3: .* already on line 2.*number",
        ),
        ([(0, "measure", "2"), (0, "measure", "1")], r"frames\.csv:3: .* already on line 2"),
        ([(0, "measure", ""), (0, "measure", "")], r"frames\.csv:3: .* already on line 2"),
        ([(0, "measure", "1"), (0, "rig", "2")], r"frames\.csv:3: role rig, but .* measure"),
        ([(0, "measure", "first")], r"frames\.csv:2: bad number 'first' in column 'burst'"),
        ([(0, "measure", "0")], r"frames\.csv:2: bad number '0' in column 'burst'"),
        (
            [(0, "reference", "1"), (0, "reference", "2"), (1, "reference", "1")],
            r"frames\.csv:4: second reference, the first is on line 2",
        ),
    ],
)
def test_wrong_numbers_in_a_burst_are_named(tmp_path: Path, cells: list, message: str) -> None:
    """With file, line and what to do."""
    with pytest.raises(FrameSetError, match=message):
        read_frame_set(_table(tmp_path, *_burst(*cells), header=f"{HEADER},burst"))


def test_table_is_read(tmp_path: Path) -> None:
    """Roles, times in UTC, names and angles come as they stand in the table."""
    frames = read_frame_set(_table(tmp_path, *ROWS))
    assert [row.role for row in frames.rows] == ["intrinsics", "reference", "rig", "measure"]
    assert frames.rows[0].main is None
    assert frames.rows[0].pan_deg is None
    assert frames.rows[2].slot_utc == datetime(2026, 3, 1, 0, 2, tzinfo=UTC)
    assert (frames.rows[2].pan_deg, frames.rows[2].tilt_deg) == (0.1358, -0.0433)
    assert [row.main for row in frames.rows_of("reference", "rig")] == [
        "0001_main.png",
        "0002_main.png",
    ]


def test_tables_of_spreadsheets_are_read(tmp_path: Path) -> None:
    """A byte-order mark, CRLF line ends, blank lines and columns in another order do no harm."""
    header = "role,slot_utc,sub,main,tilt_deg,pan_deg,skew_s"
    row = "measure,2026-03-01T00:03:00Z,s.png,m.png,2.0,1.0,0.001"
    (tmp_path / "frames.csv").write_bytes(b"\xef\xbb\xbf" + f"{header}\r\n{row}\r\n\r\n".encode())
    (only,) = read_frame_set(tmp_path).rows
    assert (only.main, only.sub, only.pan_deg, only.tilt_deg) == ("m.png", "s.png", 1.0, 2.0)
    assert only.extra == {"skew_s": "0.001"}


def test_temperatures_and_readings_are_numbers_of_a_row(tmp_path: Path) -> None:
    """Optional columns by their names; an empty cell is no value, another name another's column."""
    header = f"{HEADER},temperature_sub_c,reading_air,temperature_main_c,reading_Air,reading_deck-2"
    rows = [f"{ROWS[1]},31.5,-4.25,,warm,", f"{ROWS[3]},,,40,,1e3"]
    first, second = read_frame_set(_table(tmp_path, *rows, header=header)).rows
    assert (first.main_temperature_c, first.sub_temperature_c) == (None, 31.5)
    assert (second.main_temperature_c, second.sub_temperature_c) == (40.0, None)
    assert (first.readings, second.readings) == ({"air": -4.25}, {"deck-2": 1000.0})
    assert first.extra["reading_Air"] == "warm"
    (plain,) = read_frame_set(_table(tmp_path, ROWS[3])).rows
    assert (plain.main_temperature_c, plain.readings) == (None, {})


@pytest.mark.parametrize("column", ["temperature_main_c", "temperature_sub_c", "reading_air"])
def test_a_reading_that_is_no_number_is_named(tmp_path: Path, column: str) -> None:
    """With file, line and what to do; so is a column that stands twice."""
    for text in ("warm", "nan", "1,5", "inf"):
        row = f'{ROWS[3]},"{text}"'
        with pytest.raises(
            FrameSetError, match=rf"csv:2: bad number '{text}' in column '{column}'"
        ):
            read_frame_set(_table(tmp_path, row, header=f"{HEADER},{column}"))
    with pytest.raises(FrameSetError, match=rf"csv:1: column '{column}' is given twice"):
        read_frame_set(_table(tmp_path, f"{ROWS[3]},1,2", header=f"{HEADER},{column},{column}"))


def test_rows_with_other_columns_make_one_table(tmp_path: Path) -> None:
    """As when a calibration goes on that an older version began."""
    step, warm = {"step": "1"}, {"temperature_main_c": "40.5", "step": "2"}
    rows = [
        FrameSetRow(datetime(2026, 3, day, tzinfo=UTC), "measure", "m.png", "s.png", extra=extra)
        for day, extra in ((1, step), (2, warm), (3, {}))
    ]
    write_table(tmp_path, rows)
    read = read_frame_set(tmp_path).rows
    assert [row.extra["step"] for row in read] == ["1", "2", ""]
    assert [row.main_temperature_c for row in read] == [None, 40.5, None]


def test_table_round_trip(tmp_path: Path) -> None:
    """What is written is read back, extra columns, commas and all."""
    rows = (
        FrameSetRow(datetime(2026, 3, 1, tzinfo=UTC), "reference", "a,b.png", "s.png", 0.1, -0.2),
        FrameSetRow(datetime(2026, 3, 2, tzinfo=UTC), "measure", None, None),
    )
    rows = tuple(FrameSetRow(*_fields(row), extra={"skew_s": "1e-3", "bits": ""}) for row in rows)
    write_table(tmp_path, rows)
    assert read_frame_set(tmp_path).rows == rows
    assert [path.name for path in tmp_path.iterdir()] == ["frames.csv"]
    lines = [format_header(rows[0].extra), *map(format_row, rows)]
    assert (tmp_path / "frames.csv").read_text().splitlines() == lines


def _fields(row: FrameSetRow) -> tuple[object, ...]:
    return tuple(getattr(row, name) for name in COLUMNS)


def test_slot_text_round_trip() -> None:
    """A slot is written with Z and read back as the same instant."""
    when = datetime(2026, 3, 1, 23, 59, 7, tzinfo=UTC)
    assert format_slot(when) == "2026-03-01T23:59:07Z"
    assert parse_slot("2026-03-01T23:59:07Z") == when
    assert parse_slot("2026-03-01T23:59:07+00:00") == when


@pytest.mark.parametrize("column", COLUMNS)
def test_missing_column_is_named(tmp_path: Path, column: str) -> None:
    """Each required column is asked for by its name."""
    header = ",".join(name for name in COLUMNS if name != column)
    with pytest.raises(FrameSetError, match=f"frames.csv:1: column '{column}' is missing"):
        read_frame_set(_table(tmp_path, header=header))


@pytest.mark.parametrize(
    ("row", "line"),
    [
        (ROWS[3], r"frames.csv:6: slot 2026-03-01T00:03:00Z is already on line 5"),
        ("2026-03-01T00:02:30Z,measure,m,s,,", r":6: slot .* is before the row above"),
        ("2026-03-01T00:09:00Z,reference,m,s,,", r":6: second reference, the first is on line 3"),
        ("2026-03-01T00:09:00Z,measured,m,s,,", r":6: unknown role 'measured'; use one of intri"),
        ("2026-03-01 00:99,measure,m,s,,", r":6: bad time '2026-03-01 00:99'"),
        ("2026-03-01T00:09:00,measure,m,s,,", r":6: bad time .* write UTC"),
        ("2026-03-01T00:09:00+01:00,measure,m,s,,", r":6: bad time .* write UTC"),
        ("2026-03-01T00:09:00.5Z,measure,m,s,,", r":6: bad time .* whole seconds"),
        (",measure,m,s,,", r":6: bad time ''"),
        ("2026-03-01T00:09:00Z,rig,m,,,", r":6: column 'sub' is empty; a row of role rig"),
        ("2026-03-01T00:09:00Z,rig,m,s,left,", r":6: bad angle 'left' in column 'pan_deg'"),
        ("2026-03-01T00:09:00Z,rig,m,s,,nan", r":6: bad angle 'nan' in column 'tilt_deg'"),
        ("2026-03-01T00:09:00Z,measure,m,s", r":6: 4 fields, the header has 6"),
        ("2026-03-01T00:09:00Z,measure,m,s,,,,", r":6: 8 fields, the header has 6"),
        ("2026-03-01T00:09:00Z,measure,../m,s,,", r":6: file name '../m' in column 'main' leads"),
        ("2026-03-01T00:09:00Z,measure,m,/s,,", r":6: file name '/s' in column 'sub' leads out"),
        ('2026-03-01T00:09:00Z,measure,"m,s,,', r"frames.csv:6: not a CSV line"),
    ],
)
def test_damaged_row_is_named(tmp_path: Path, row: str, line: str) -> None:
    """A row that cannot be right stops the reading, with its line, what is wrong, what to do."""
    with pytest.raises(FrameSetError, match=line) as caught:
        read_frame_set(_table(tmp_path, *ROWS, row))
    assert "\n" not in str(caught.value)
    assert ";" in str(caught.value)


def test_unreadable_tables(tmp_path: Path) -> None:
    """No directory, no table, an empty one, one that is not text: one line each."""
    with pytest.raises(FrameSetError, match="no such directory"):
        read_frame_set(tmp_path / "nowhere")
    with pytest.raises(FrameSetError, match=r"frames.csv: not there; .*slot_utc"):
        read_frame_set(tmp_path)
    (tmp_path / "frames.csv").write_bytes(b"")
    with pytest.raises(FrameSetError, match=r"frames.csv: empty; .*slot_utc"):
        read_frame_set(tmp_path)
    (tmp_path / "frames.csv").write_bytes(b"\xff\xfe\x00s")
    with pytest.raises(FrameSetError, match=r"frames.csv: not UTF-8"):
        read_frame_set(tmp_path)
    with pytest.raises(FrameSetError, match="column 'role' is given twice"):
        read_frame_set(_table(tmp_path, header=HEADER + ",role"))


# ---------------------------------------------------------------------------------- the images


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_image_round_trip(tmp_path: Path, dtype: type) -> None:
    """8 and 16 bits come back exactly."""
    pixels = _noise(dtype)
    (tmp_path / "a.png").write_bytes(encode_png(pixels))
    image = read_image(tmp_path / "a.png")
    np.testing.assert_array_equal(image.pixels, pixels)
    assert image.pixels.dtype == dtype
    assert image.bits == np.dtype(dtype).itemsize * 8


def test_significant_bits_are_kept(tmp_path: Path) -> None:
    """A 12-bit camera's saturation is still known after the image was on disk."""
    pixels = _noise(np.uint16) >> 4
    (tmp_path / "a.png").write_bytes(encode_png(pixels, 12))
    image = read_image(tmp_path / "a.png")
    assert image.bits == 12
    np.testing.assert_array_equal(image.pixels, pixels)
    decoded = cv2.imdecode(np.fromfile(tmp_path / "a.png", np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decoded, pixels)


def test_every_truncation_is_caught(tmp_path: Path) -> None:
    """A PNG cut at any byte is refused: OpenCV alone would give a half grey picture."""
    data = encode_png(_noise(np.uint8, (30, 40)))
    path = tmp_path / "a.png"
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(FrameSetError, match=r"a\.png: (truncated|not a PNG|an empty file)"):
            read_image(path)


def test_every_damaged_byte_is_caught(tmp_path: Path) -> None:
    """One flipped bit anywhere in a PNG is refused."""
    data = encode_png(_noise(np.uint8, (20, 30)))
    path = tmp_path / "a.png"
    for at in range(len(data)):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])
        with pytest.raises(FrameSetError, match=r"a\.png: "):
            read_image(path)


def _headed(depth: int, kind: int) -> bytes:
    body = b"IHDR" + struct.pack(">IIBBBBB", 8, 8, depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + b"\0\0\0\r" + body + struct.pack(">I", zlib.crc32(body))


def _png(pixels: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1])


@pytest.mark.parametrize(
    ("data", "line"),
    [
        (_png(np.zeros((8, 8, 3), np.uint8)), "a colour image; store it as 8- or 16-bit greyscale"),
        (_png(np.zeros((8, 8, 4), np.uint8)), "a colour image"),
        (_headed(8, 4), "a greyscale with alpha image"),
        (_headed(1, 0), "1 bits a pixel; store it as 8- or 16-bit"),
        (bytes(cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1]), "not a PNG file"),
        (b"", r"an empty file \(0 bytes\)"),
        (b"\x89PNG\r\n\x1a\n", "truncated after 8 bytes"),
    ],
)
def test_unusable_image_is_named(tmp_path: Path, data: bytes, line: str) -> None:
    """Colour, alpha, odd depths, other formats and empty files are refused by name."""
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(FrameSetError, match=rf"a\.png: {line}"):
        read_image(tmp_path / "a.png")


def test_missing_image_is_distinguished_from_a_damaged_one(tmp_path: Path) -> None:
    """A file that is not there raises its own class, so that a row can say so."""
    frames = read_frame_set(_table(tmp_path, *ROWS))
    with pytest.raises(ImageMissingError, match=r"0000_sub\.png: not there"):
        frames.read("0000_sub.png")
    with pytest.raises(FrameSetError, match="cannot be read") as caught:
        read_image(tmp_path)
    assert not isinstance(caught.value, ImageMissingError)


def test_an_image_larger_than_any_camera_s_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    """Its file is small; its pixels would take gigabytes."""
    data = bytearray(encode_png(np.zeros((30, 40), dtype=np.uint8)))
    data[16:24] = struct.pack(">2I", 30_000, 30_000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(FrameSetError, match=r"a\.png: 30000x30000 px, larger than any camera's"):
        read_image(tmp_path / "a.png")
