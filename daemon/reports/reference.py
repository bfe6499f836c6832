"""A reference that others measured or computed, from a CSV file: `--reference`.

Columns, in any order: `time` (ISO 8601 with its zone), `x_mm` and `y_mm` (one of them, or both),
their standard uncertainties `sigma_x_mm` and `sigma_y_mm` or one `sigma_mm` for both, `point`
(which point of the bridge; without it the main target), `remark`. Axes and signs are the record's.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from core.analysis.comparison import TimedValues
from core.site import MAIN
from daemon.errors import HardwareError, WorkFailedError
from daemon.file_errors import file_error_text

MOST_BYTES = 20_000_000
"""A reference is sparse: this is some 400,000 lines."""
AXES = ("x", "y")
_KNOWN = {"time", "x_mm", "y_mm", "sigma_mm", "sigma_x_mm", "sigma_y_mm", "point", "remark"}
_EXAMPLE = "time,y_mm,sigma_mm"


@dataclass(frozen=True, slots=True)
class Reference:
    """What a file says, by point and axis (`x`, `y`)."""

    name: str
    """Of the file."""
    series: Mapping[tuple[str, str], TimedValues]
    """In the order of time; only those with a value."""

    @property
    def points(self) -> tuple[str, ...]:
        """Those with a value, in the file's order."""
        return tuple(dict.fromkeys(point for point, _ in self.series))


def read_reference(path: Path) -> Reference:
    """Read a file. Raises WorkFailedError, which names the line and what is wrong with it.

    Raises HardwareError for a file that cannot be read.
    """
    kept: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for number, line in _lines(path):
        where = f"{path}, line {number}"
        time_s, point = _time(line.get("time", ""), where), line.get("point") or MAIN
        if not any(line.get(f"{axis}_mm") for axis in AXES):
            msg = f"{where}: neither x_mm nor y_mm has a value; give one, or leave the line out"
            raise WorkFailedError(msg)
        for axis in AXES:
            if line.get(f"{axis}_mm"):
                mm = _number(line[f"{axis}_mm"], f"{where}: {axis}_mm")
                sigma_mm = _sigma(line, axis, where)
                kept.setdefault((point, axis), []).append((time_s, mm, sigma_mm))
    if not kept:
        msg = f"{path}: no line with a value below the column names {_EXAMPLE}"
        raise WorkFailedError(msg)
    series = {}
    for key, values in kept.items():
        times_s, mm, sigma_mm = np.array(sorted(values), dtype=np.float64).T
        series[key] = TimedValues(times_s, mm, sigma_mm)
    return Reference(path.name, series)


def _lines(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Number and cells of each line below the names; empty ones and those with # are left out."""
    lines = [
        (number, line)
        for number, line in enumerate(_text(path).splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        msg = f"{path}: empty; the first line names the columns: {_EXAMPLE}"
        raise WorkFailedError(msg)
    first = lines[0][1]
    separator = next((sign for sign in (";", "\t") if sign in first), ",")
    names = [name.strip().lower() for name in first.split(separator)]
    _check_names(path, names)
    for (number, _), cells in zip(
        lines[1:], csv.reader((line for _, line in lines[1:]), delimiter=separator), strict=True
    ):
        if len(cells) > len(names):
            msg = (
                f"{path}, line {number}: {len(cells)} cells, but {len(names)} columns are named; "
                "write decimals with a point, or separate columns with ;"
            )
            raise WorkFailedError(msg)
        values = (cell.strip() for cell in cells)
        yield number, dict(zip(names, values, strict=False))


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise HardwareError(file_error_text(error)) from None
    if len(content) > MOST_BYTES:
        msg = f"{path}: more than {MOST_BYTES // 1_000_000} MB; give fewer times, a mean an hour"
        raise WorkFailedError(msg)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", "replace")


def _check_names(path: Path, names: list[str]) -> None:
    unknown = [name for name in names if name not in _KNOWN]
    if unknown:
        msg = (
            f'{path}: unknown column "{unknown[0]}"; there may be {", ".join(sorted(_KNOWN))}'
            " (a text of your own: remark)"
        )
        raise WorkFailedError(msg)
    if len(set(names)) < len(names):
        msg = f"{path}: a column is named twice: {', '.join(names)}"
        raise WorkFailedError(msg)
    if "time" not in names or not {"x_mm", "y_mm"} & set(names):
        msg = f"{path}: needs the columns time and x_mm or y_mm, for example {_EXAMPLE}"
        raise WorkFailedError(msg)
    for axis in AXES:
        if f"{axis}_mm" in names and not {f"sigma_{axis}_mm", "sigma_mm"} & set(names):
            msg = (
                f"{path}: {axis}_mm has no uncertainty; add a column sigma_{axis}_mm or sigma_mm: "
                "its standard uncertainty (1 sigma) in mm"
            )
            raise WorkFailedError(msg)


def _time(text: str, where: str) -> float:
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        msg = f'{where}: "{text}" is not a time; write 2026-03-01T12:00:00Z or ...T13:00:00+01:00'
        raise WorkFailedError(msg) from None
    if when.tzinfo is None:
        msg = f'{where}: "{text}" has no zone; write {text}Z for UTC, or {text}+01:00'
        raise WorkFailedError(msg)
    return when.astimezone(UTC).timestamp()


def _number(text: str, where: str) -> float:
    try:
        number = float(text.replace(",", "."))
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        msg = f'{where}: "{text}" is not a number'
        raise WorkFailedError(msg)
    return number


def _sigma(line: Mapping[str, str], axis: str, where: str) -> float:
    name = f"sigma_{axis}_mm" if line.get(f"sigma_{axis}_mm") else "sigma_mm"
    text = line.get(name, "")
    if not text:
        msg = f"{where}: {axis}_mm has no uncertainty; give sigma_{axis}_mm or sigma_mm"
        raise WorkFailedError(msg)
    sigma_mm = _number(text, f"{where}: {name}")
    if sigma_mm <= 0.0:
        msg = f"{where}: {name} is {text}; a standard uncertainty is more than 0"
        raise WorkFailedError(msg)
    return sigma_mm
