"""Sheets to print: a target at true scale with rulers, marks and notes, as a vector PDF."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO

import numpy as np
from reportlab.pdfgen.canvas import Canvas

from core.site import CheckerboardTarget, CirclesTarget
from daemon.errors import WorkFailedError

PT_PER_MM = 72.0 / 25.4
PAGES_MM = (
    ("A4", 210.0, 297.0),
    ("A4 landscape", 297.0, 210.0),
    ("A3", 297.0, 420.0),
    ("A3 landscape", 420.0, 297.0),
)
LARGEST_PAGE_MM = 5080.0
"""200 inches: what a PDF page may measure (ISO 32000-1, annex C)."""
PRINTER_MARGIN_MM = 12.0
QUIET_SQUARES, QUIET_MM = 2.0, 10.0
"""White about the board: as many squares, or so many mm if that is more."""
PLATE_DIAMETERS = 1.75
"""Black about the discs: from the outermost centres, in diameters."""
_MARK_MM, _RULER_MM, _LINE_MM = 9.0, 14.0, 4.2
_LEAST_RULER_MM = 100.0
"""A steel rule laid on it tells 0.1 %."""
_TEXT_WIDTH_MM = 150.0
_ARCS = 16
"""A circle of so many Bezier arcs is round to 1e-7 of its radius."""


@dataclass(frozen=True, slots=True)
class Ruler:
    """Where a ruler's scale is printed: from (x, y), mm from the page's top left corner."""

    x_mm: float
    y_mm: float
    length_mm: float
    vertical: bool


@dataclass(frozen=True, slots=True)
class Sheet:
    """One finished page."""

    targets: tuple[str, ...]
    """The names of the targets that it is printed for."""
    page: str
    """A4, A3, or its size in mm."""
    page_mm: tuple[float, float]
    origin_mm: tuple[float, float]
    """The target's own origin on the page, from its top left corner: WS or WM."""
    rulers: tuple[Ruler, Ruler]
    pdf: bytes


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where things stand on a page, mm from its top left corner, y down."""

    page: str
    page_mm: tuple[float, float]
    box_mm: tuple[float, float, float, float]
    """The target with its margin: left, top, width, height."""
    rulers: tuple[Ruler, Ruler]
    notes_top_mm: float


def board_sheet(target: CheckerboardTarget, site_name: str, version: str) -> Sheet:
    """Draw the checkerboard: the square at its origin, top left, is black.

    Raises WorkFailedError if it is larger than a page can be.
    """
    square = target.square_mm
    quiet = max(QUIET_SQUARES * square, QUIET_MM)
    width, height = target.squares_x * square, target.squares_y * square
    notes = [
        f"dcam {version}, site {site_name}: target of the sub-camera",
        f"checkerboard, {target.squares_x} x {target.squares_y} squares of {square:g} mm",
        f"{width:g} x {height:g} mm, read from {target.distance_mm:g} mm",
        "The corner marked WS is top left in the sub image, its square is black. x right, y down.",
        "Upside down or mirrored it looks much the same: keep the WS mark, legible and top left.",
        f"Leave {quiet:g} mm of white all around.",
        "Mount: matt, flat, glued all over on glass or aluminium, not on foam or card; no gloss.",
        *_print_notes(),
        "Other lengths in x and y by the same factor: write the true square into [target.sub].",
    ]
    layout = _lay_out("board", width + 2.0 * quiet, height + 2.0 * quiet, len(notes))
    left, top = layout.box_mm[0] + quiet, layout.box_mm[1] + quiet
    page = _Page(layout, f"dcam {site_name} sub target")
    page.squares(target, left, top)
    page.corners()
    page.origin_mark(layout.box_mm[0], layout.box_mm[1])
    return page.finished(("sub",), notes, (left, top))


def discs_sheet(targets: Mapping[str, CirclesTarget], site_name: str, version: str) -> Sheet:
    """Draw the white discs on black, as the main camera sees them, of targets of one layout.

    Raises WorkFailedError if the plate is larger than a page can be.
    """
    first, target = next(iter(targets.items()))
    distances = ", ".join(dict.fromkeys(f"{one.distance_mm:g}" for one in targets.values()))
    centres, diameters = target.centres_mm, target.diameters_mm
    margin = PLATE_DIAMETERS * float(diameters.max())
    low, high = centres.min(axis=0) - margin, centres.max(axis=0) + margin
    sizes = sorted({float(d) for d in diameters})
    notes = [
        f"dcam {version}, site {site_name}: target of the main camera{_names_note(targets)}",
        f"{len(centres)} white discs of {', '.join(f'{d:g}' for d in sizes)} mm on black",
        f"{high[0] - low[0]:g} x {high[1] - low[1]:g} mm, read from {distances} mm",
        *_centre_notes(centres),
        "UP is up on the bridge, seen from the camera; it faces the camera to a few degrees.",
        "Mount: matt, flat, glued all over on aluminium or glass, not on foam or card; no gloss.",
        *_print_notes(),
    ]
    width, height = float(high[0] - low[0]), float(high[1] - low[1])
    layout = _lay_out(f"{first} target", width, height, len(notes))
    left, top = layout.box_mm[:2]
    origin = (left - float(low[0]), top + float(high[1]))
    page = _Page(layout, f"dcam {site_name} {first} target")
    page.plate()
    for (x, y), diameter in zip(centres, diameters, strict=True):
        page.disc(origin[0] + float(x), origin[1] - float(y), 0.5 * float(diameter))
    page.up_mark(left + 0.5 * width, top)
    return page.finished(tuple(targets), notes, origin)


def _names_note(names: Iterable[str]) -> str:
    """Which targets of the config a print is for; the main target alone needs no name."""
    named = [f"[target.{name}]" if name == "main" else name for name in names]
    return "" if named == ["[target.main]"] else f": {', '.join(named)}"


def _print_notes() -> tuple[str, str]:
    return (
        "Print at 100 %, no scaling, no 'fit to page'. Then lay a steel rule on both rulers:",
        "0.1 mm off in 100 mm is fine, more is not; 0.2 mm more in x than in y neither.",
    )


def _centre_notes(centres: np.ndarray) -> list[str]:
    """The centres, four to a line; not more than two lines of them."""
    texts = [f"({x:g}, {y:g})" for x, y in centres]
    lines = [" ".join(texts[k : k + 5]) for k in range(0, len(texts), 5)]
    shown = lines if len(lines) <= 2 else [lines[0], f"... {len(texts)} in all, see the config"]
    return [f"centres in mm, x right, y up: {shown[0]}", *shown[1:]]


def _lay_out(what: str, width: float, height: float, note_count: int) -> _Layout:
    """Choose the smallest page that holds target, rulers and notes."""
    ruler_x, ruler_y = (max(10.0 * math.floor(x / 10.0), _LEAST_RULER_MM) for x in (width, height))
    notes = note_count * _LINE_MM
    across = _RULER_MM + max(width, ruler_x + 2.0, _TEXT_WIDTH_MM)
    down = _MARK_MM + max(height, ruler_y + 2.0) + _RULER_MM + notes
    needed = across + 2.0 * PRINTER_MARGIN_MM, down + 2.0 * PRINTER_MARGIN_MM
    fitting = [p for p in PAGES_MM if p[1] >= needed[0] and p[2] >= needed[1]]
    if fitting:
        name, *size = fitting[0]
    else:
        size = [float(math.ceil(x)) for x in needed]
        name = f"{size[0]:g} x {size[1]:g} mm"
    if max(size) > LARGEST_PAGE_MM:
        msg = (
            f"target: the {what} needs a page of {name}, the largest that PDF knows is "
            f"{LARGEST_PAGE_MM:g} mm; check its sizes in the config"
        )
        raise WorkFailedError(msg)
    left = PRINTER_MARGIN_MM + _RULER_MM + max(0.0, 0.5 * (size[0] - needed[0]))
    top = PRINTER_MARGIN_MM + _MARK_MM
    below = top + max(height, ruler_y + 2.0)
    rulers = (
        Ruler(left, below + 3.0, ruler_x, vertical=False),
        Ruler(left - 3.0, top, ruler_y, vertical=True),
    )
    return _Layout(name, (size[0], size[1]), (left, top, width, height), rulers, below + _RULER_MM)


class _Page:
    """Draws in mm from the page's top left corner, y down."""

    def __init__(self, layout: _Layout, title: str) -> None:
        self._layout = layout
        self._buffer = BytesIO()
        width, height = layout.page_mm
        size = (width * PT_PER_MM, height * PT_PER_MM)
        self._canvas = Canvas(self._buffer, pagesize=size, invariant=1)
        self._canvas.setTitle(_latin(title))
        self._canvas.setViewerPreference("PrintScaling", "None")
        # From here on a unit is a millimetre and y still goes up: text would be upside down else.
        self._canvas.scale(PT_PER_MM, PT_PER_MM)
        self._height = height

    def _up(self, y_mm: float) -> float:
        return self._height - y_mm

    def squares(self, target: CheckerboardTarget, left: float, top: float) -> None:
        """Black squares, all in one path."""
        path, side = self._canvas.beginPath(), target.square_mm
        for j in range(target.squares_y):
            for i in range(j % 2, target.squares_x, 2):
                path.rect(left + i * side, self._up(top + (j + 1) * side), side, side)
        self._canvas.drawPath(path, stroke=0, fill=1)

    def plate(self) -> None:
        """The black about the discs."""
        left, top, width, height = self._layout.box_mm
        self._canvas.rect(left, self._up(top + height), width, height, stroke=0, fill=1)

    def disc(self, x: float, y: float, radius: float) -> None:
        """Draw a white disc."""
        path, middle = self._canvas.beginPath(), self._up(y)
        box = (x - radius, middle - radius, x + radius, middle + radius)
        step = 360.0 / _ARCS
        path.arc(*box, 0.0, step)
        for k in range(1, _ARCS):
            path.arcTo(*box, k * step, step)
        path.close()
        self._canvas.setFillGray(1.0)
        self._canvas.drawPath(path, stroke=0, fill=1)
        self._canvas.setFillGray(0.0)

    def corners(self) -> None:
        """Short lines where to cut, outside the white margin."""
        left, top, width, height = self._layout.box_mm
        for x, away_x in ((left, -1.0), (left + width, 1.0)):
            for y, away_y in ((top, -1.0), (top + height, 1.0)):
                self._line(x + away_x, y, x + 2.5 * away_x, y)
                self._line(x, y + away_y, x, y + 2.5 * away_y)

    def origin_mark(self, x: float, y: float) -> None:
        """Name the corner that is the WS origin, outside the white margin."""
        self._text(x + 2.0, y - 3.2, "WS origin: this corner is top left in the sub image", 2.6)

    def up_mark(self, x: float, y: float) -> None:
        """Draw an arrow and UP above the plate."""
        self._line(x, y - 1.0, x, y - 7.0)
        self._line(x, y - 7.0, x - 1.2, y - 5.0)
        self._line(x, y - 7.0, x + 1.2, y - 5.0)
        self._text(x + 3.0, y - 3.0, "UP", 4.0)

    def finished(
        self, targets: tuple[str, ...], notes: Sequence[str], origin_mm: tuple[float, float]
    ) -> Sheet:
        """Add rulers and notes, and close the page."""
        layout = self._layout
        for ruler in layout.rulers:
            self._ruler(ruler)
        for k, note in enumerate(notes):
            baseline = layout.notes_top_mm + (k + 1) * _LINE_MM
            self._text(layout.box_mm[0], baseline, note, 3.0)
        self._canvas.showPage()
        self._canvas.save()
        pdf = self._buffer.getvalue()
        return Sheet(targets, layout.page, layout.page_mm, origin_mm, layout.rulers, pdf)

    def _ruler(self, ruler: Ruler) -> None:
        """A tick each mm, its middle on the mark."""
        for mm in range(round(ruler.length_mm) + 1):
            tick = 5.0 if mm % 10 == 0 else 3.5 if mm % 5 == 0 else 2.0
            if ruler.vertical:
                y = ruler.y_mm + mm
                self._line(ruler.x_mm, y, ruler.x_mm - tick, y)
            else:
                x = ruler.x_mm + mm
                self._line(x, ruler.y_mm, x, ruler.y_mm + tick)
            if mm % 10 == 0:
                if ruler.vertical:
                    self._text(ruler.x_mm - 9.5, ruler.y_mm + mm + 0.9, f"{mm}", 2.4)
                else:
                    self._text(ruler.x_mm + mm - 1.2, ruler.y_mm + 8.0, f"{mm}", 2.4)

    def _line(self, x0: float, y0: float, x1: float, y1: float) -> None:
        self._canvas.setLineWidth(0.15)
        self._canvas.line(x0, self._up(y0), x1, self._up(y1))

    def _text(self, x: float, y: float, text: str, size_mm: float) -> None:
        self._canvas.setFont("Helvetica", size_mm)
        self._canvas.drawString(x, self._up(y), _latin(text))


def _latin(text: str) -> str:
    """What the fonts that every PDF reader has can show; a question mark for the rest."""
    return text.encode("cp1252", "replace").decode("cp1252")
