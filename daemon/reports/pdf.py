"""A document as PDF: A4, tables that go on over pages, figures that stay vectors."""

from __future__ import annotations

import importlib.util
import io
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from reportlab.lib import colors
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.lib.units import mm
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.platypus import (
    BaseDocTemplate,
    Flowable,
    Frame,
    KeepTogether,
    ListFlowable,
    LongTable,
    PageTemplate,
    Paragraph,
    Spacer,
)

from daemon.reports.document import (
    Block,
    Bullets,
    Document,
    Formula,
    Heading,
    Picture,
    Table,
    Text,
)

_MARGIN = 17 * mm
_WIDTH = A4[0] - 2 * _MARGIN
_HEIGHT = A4[1] - 2 * _MARGIN - 8 * mm
_LEVELS = {"OK": "#009e73", "WARNING": "#e69f00"}
_SERIOUS = "#d55e00"
_FEWEST_LETTERS = 4
"""Width of the narrowest column of a table."""
_MOST_LETTERS = 42
"""Beyond which a column's longest cell does not widen it: it is wrapped."""


@dataclass(frozen=True, slots=True)
class _Fonts:
    """One with the letters of most of Europe, where matplotlib brought it; else Helvetica."""

    plain: str
    bold: str
    letters: frozenset[int] | None
    """That it has; None: those of the code page 1252."""

    def shown(self, text: str) -> str:
        """The text as markup; a question mark for a letter that the font lacks."""
        if self.letters is None:
            known = text.encode("cp1252", "replace").decode("cp1252")
        else:
            known = "".join(sign if ord(sign) in self.letters else "?" for sign in text)
        return escape("".join(sign if sign.isprintable() else " " for sign in known))


def _fonts() -> _Fonts:
    found = importlib.util.find_spec("matplotlib")
    if found is None or found.origin is None:
        return _Fonts("Helvetica", "Helvetica-Bold", None)
    folder = Path(found.origin).parent / "mpl-data" / "fonts" / "ttf"
    names = {"DejaVuSans": "DejaVuSans.ttf", "DejaVuSans-Bold": "DejaVuSans-Bold.ttf"}
    if not all((folder / file).is_file() for file in names.values()):
        return _Fonts("Helvetica", "Helvetica-Bold", None)
    for name, file in names.items():
        if name not in pdfmetrics.getRegisteredFontNames():
            pdfmetrics.registerFont(TTFont(name, str(folder / file)))
    face = pdfmetrics.getFont("DejaVuSans").face
    return _Fonts("DejaVuSans", "DejaVuSans-Bold", frozenset(face.charToGlyph))


@dataclass(slots=True)
class _Place:
    """Where a figure comes to stand."""

    page: int
    x: float
    y: float
    scale: float
    pdf: bytes


class _Space(Flowable):  # type: ignore[misc]  # reportlab ships no types
    """Room for a figure, which is laid over the finished page."""

    def __init__(self, picture: Picture, places: list[_Place]) -> None:
        super().__init__()
        self._pdf, self._places = picture.pdf, places
        width, height = _size_of(picture.pdf)
        self._scale = min(_WIDTH / width, 0.98 * _HEIGHT / height)
        self.width, self.height = width * self._scale, height * self._scale

    def draw(self) -> None:
        x, y = self.canv.absolutePosition(0, 0)
        page = self.canv.getPageNumber() - 1
        self._places.append(_Place(page, x, y, self._scale, self._pdf))


def _size_of(pdf: bytes) -> tuple[float, float]:
    from pypdf import PdfReader

    box = PdfReader(io.BytesIO(pdf)).pages[0].mediabox
    return float(box.width), float(box.height)


@dataclass(slots=True)
class _Writer:
    """Makes reportlab's pieces of ours."""

    fonts: _Fonts
    places: list[_Place] = field(default_factory=list)

    def style(self, size: float, **more: Any) -> ParagraphStyle:
        font = self.fonts.bold if more.pop("bold", False) else self.fonts.plain
        return ParagraphStyle(
            "s", fontName=font, fontSize=size, leading=1.3 * size, splitLongWords=1, **more
        )

    def paragraph(self, text: str, size: float = 9.0, **more: Any) -> Paragraph:
        return Paragraph(self.fonts.shown(text), self.style(size, **more))

    def pieces(self, block: Block) -> list[Any]:
        """What stands on the page for a block."""
        if isinstance(block, Heading):
            size = {2: 13.0, 3: 10.5}.get(block.level, 9.5)
            before = 14.0 if block.level == 2 else 8.0
            return [
                self.paragraph(
                    block.text, size, bold=True, spaceBefore=before, spaceAfter=4, keepWithNext=1
                )
            ]
        if isinstance(block, Text):
            return [self.paragraph(block.text, bold=block.is_strong, spaceAfter=4)]
        if isinstance(block, Formula):
            return [self.paragraph(block.text, 10.0, leftIndent=20, spaceBefore=3, spaceAfter=6)]
        if isinstance(block, Bullets):
            items = [self.paragraph(item, 8.5) for item in block.items]
            return [
                ListFlowable(
                    items, bulletType="bullet", start="•", leftIndent=12, bulletFontName="Helvetica"
                ),
                Spacer(1, 4),
            ]
        if isinstance(block, Table):
            return [self.table(block), Spacer(1, 6)]
        if isinstance(block, Picture):
            return [_Space(block, self.places), Spacer(1, 6)]
        colour = colors.HexColor(_LEVELS.get(block.level, _SERIOUS))
        return [self.paragraph(block.text, 11.0, bold=True, textColor=colour, spaceAfter=4)]

    def table(self, block: Table) -> LongTable:
        size = 7.0 if len(block.header) < 8 else 6.2
        cells = [
            [
                self.paragraph(
                    cell, size, bold=not number, alignment=2 if k in block.numbers else 0
                )
                for k, cell in enumerate(row)
            ]
            for number, row in enumerate((block.header, *block.rows))
        ]
        letters = [
            min(max(_FEWEST_LETTERS, *map(len, column)), _MOST_LETTERS)
            for column in zip(block.header, *block.rows, strict=True)
        ]
        widest = _WIDTH / (0.62 * size)
        share = min(1.0, widest / (sum(letters) + 2.0 * len(letters)))
        widths = [share * 0.62 * size * (count + 2.0) for count in letters]
        style = [
            ("VALIGN", (0, 0), (-1, -1), "TOP"),
            ("LINEBELOW", (0, 0), (-1, -1), 0.25, colors.HexColor("#cccccc")),
            ("LEFTPADDING", (0, 0), (-1, -1), 2),
            ("RIGHTPADDING", (0, 0), (-1, -1), 3),
            ("TOPPADDING", (0, 0), (-1, -1), 1),
            ("BOTTOMPADDING", (0, 0), (-1, -1), 2),
        ]
        return LongTable(cells, colWidths=widths, repeatRows=1, hAlign="LEFT", style=style)


def write_pdf(document: Document) -> bytes:
    """Make the PDF. The same document gives the same bytes."""
    writer = _Writer(_fonts())
    story: list[Any] = [writer.paragraph(document.site, 18.0, bold=True, spaceAfter=6)]
    held: list[Any] = []
    for block in document.blocks:
        pieces = writer.pieces(block)
        if isinstance(block, Heading):
            held += pieces
            continue
        if held and not isinstance(block, Table):
            pieces = [KeepTogether([*held, *pieces[:1]]), *pieces[1:]]
        else:
            pieces = [*held, *pieces]
        story += pieces
        held = []
    file = io.BytesIO()
    frame = Frame(_MARGIN, _MARGIN + 8 * mm, _WIDTH, _HEIGHT, 0, 0, 0, 0)
    template = BaseDocTemplate(
        file, pagesize=A4, title=document.title, author="dcam", invariant=1, pageCompression=1
    )
    foot = writer.fonts.shown(document.title)

    def footer(canvas: Any, _template: Any) -> None:
        canvas.setFont(writer.fonts.plain, 7)
        canvas.setFillGray(0.35)
        canvas.drawString(_MARGIN, _MARGIN, _unescaped(foot)[:130])
        canvas.drawRightString(A4[0] - _MARGIN, _MARGIN, f"page {canvas.getPageNumber()}")

    template.addPageTemplates(PageTemplate("page", [frame], onPage=footer))
    template.build([*story, *held])
    return _with_figures(file.getvalue(), writer.places)


def _unescaped(text: str) -> str:
    from html import unescape

    return unescape(text)


def _with_figures(pdf: bytes, places: list[_Place]) -> bytes:
    if not places:
        return pdf
    from pypdf import PdfReader, PdfWriter, Transformation

    writer = PdfWriter(clone_from=io.BytesIO(pdf))
    for place in places:
        figure = PdfReader(io.BytesIO(place.pdf)).pages[0]
        move = Transformation().scale(place.scale).translate(place.x, place.y)
        writer.pages[place.page].merge_transformed_page(figure, move)
    file = io.BytesIO()
    writer.write(file)
    return file.getvalue()
