"""The paper's numerical validation: its Table 2 and Fig. 7."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from daemon.commands.output import progress
from studies.figure import COLOURS, new_figure
from studies.keep import Keep
from studies.numerical_points import BLOCKS, FRAMES, SEED, WIDTHS_PX, Points, compute, ways
from studies.page import Claim, Report, Table

CODE = ("studies/numerical_points.py",)
Found = dict[tuple[str, bool], dict[str, list[float]]]
"""By points and whether calibrated by pan and tilt: max and rms by method and block, mm."""


def run(
    keep: Keep,
    *,
    frames: int = FRAMES,
    points: Sequence[Points] | None = None,
    by_pan_tilt: Sequence[bool] = (False, True),
) -> Report:
    """Compute every block and judge."""
    points = ways() if points is None else points
    found: Found = {}
    with progress(len(points) * len(by_pan_tilt), "numerical validation") as steps:
        for way in points:
            for pan_tilt in by_pan_tilt:
                name = f"{way.name} {'b' if pan_tilt else 'a'}"
                parameters = {**asdict(way), "frames": frames, "seed": SEED, "pan_tilt": pan_tilt}
                found[way.name, pan_tilt] = keep.block(
                    name.replace(" ", "-").replace(",", ""),
                    parameters,
                    partial(compute, way, pan_tilt=pan_tilt, frames=frames, seed=SEED),
                )
                steps.next(name)
    return report(found, frames)


def report(found: Found, frames: int) -> Report:
    """Write the page."""
    tables = {
        f"{method}-{letter}": _table(found, method, pan_tilt=pan_tilt)
        for letter, pan_tilt in (("a", False), ("b", True))
        for method in ("paper", "rigid")
    }
    fine = next(name for name, _ in found if name.startswith("1920") and "sub" in name)
    paper_mm, rigid_mm = (found[fine, True][f"{m}, 6-DOF"][0] for m in ("paper", "rigid"))
    claims = [
        Claim(
            "calibrated with pan-tilt motions, at 1920 x 1200 with sub-pixel points, `paper` "
            f"errs by millimetres in the 6-DOF block: at most {paper_mm:.1f} mm",
            paper_mm > 1.0,
        ),
        Claim(
            f"there `rigid` stays below 0.1 mm: at most {rigid_mm:.3f} mm",
            rigid_mm < 0.1,
        ),
    ]
    text = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    text = text.replace("{frames}", str(frames)).replace("{total}", str(frames * len(BLOCKS)))
    figures = {"numerical.png": partial(draw, found)}
    return Report("numerical", "Numerical validation", text, tables, claims, figures)


def _table(found: Found, method: str, *, pan_tilt: bool) -> Table:
    rows = []
    for (name, of_pan_tilt), result in found.items():
        if of_pan_tilt is pan_tilt:
            cells = (result[f"{method}, {block}"] for block in BLOCKS)
            rows.append((name, *(f"{most:.3f} / {rms:.3f}" for most, rms in cells)))
    return Table(("points", *BLOCKS), tuple(rows))


def draw(found: Found, output: Path) -> None:
    """Draw the rms of the 6-DOF block over the resolution, as the paper's Fig. 7."""
    figure, axes = new_figure(10.0, 4.2, columns=2)
    for panel, (letter, pan_tilt) in zip(axes, (("a", False), ("b", True)), strict=True):
        for method, colour in (("paper", COLOURS[0]), ("rigid", COLOURS[1])):
            for kind, style in (("whole px", "o-"), ("sub-pixel", "s--")):
                names = [n for n, of in found if of is pan_tilt and n.endswith(kind)]
                widths = [int(name.split()[0]) for name in names]
                rms = [found[name, pan_tilt][f"{method}, 6-DOF"][1] for name in names]
                panel.loglog(widths, rms, style, color=colour, label=f"{method}, {kind}")
        motions = "pan-tilt motions only" if pan_tilt else "6-DOF motions"
        panel.set_title(f"({letter}) calibrated with {motions}", fontsize=10)
        panel.set_xticks(WIDTHS_PX, [str(width) for width in WIDTHS_PX])
        panel.set_xticks([], minor=True)
        panel.set_xlabel("image width (px)")
        panel.grid(alpha=0.25, linewidth=0.5, which="both")
        panel.set_ylim(1e-3, 30.0)
    axes[0].set_ylabel("error in the 6-DOF block, rms (mm)")
    axes[1].legend(fontsize=8, frameon=False, loc="lower left")
    figure.savefig(output, dpi=110)
