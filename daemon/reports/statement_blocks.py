"""The statement of uncertainty as pieces of a report, after GUM (JCGM 100) and EA-4/02."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime

import numpy as np

from core.analysis.budget import COVERAGE, RELIABILITY, Input, two_digits
from core.analysis.monte_carlo import AGREEMENT
from daemon.reports.document import Block, Bullets, Formula, Heading, Text, table
from daemon.reports.history import GoodRows
from daemon.reports.statement import (
    Statement,
    calibration_hash,
    expected_span,
    software_hash,
)
from daemon.slots.identity import made_by
from daemon.store.records import MeasurementRecord

_AXES = ((0, "x"), (1, "y"))
_NOT_COVERED = (
    "the pier's own movement: displacement is that of the main target beside the board on the pier",
    "haze and vibration that differ from one pair to the next, where a slot has one pair only",
    (
        "an error of the lengths given in the config: the discs' distances on the plate (it scales "
        "every "
        "displacement) and the squares of the board"
    ),
    (
        "correlation between rows: rows of one calibration share its part, so that a mean of rows "
        "is no "
        "better in that part than one row"
    ),
)


def statement_blocks(
    statement: Statement | str,
    good: GoodRows | None,
    when: Callable[[datetime], str],
    traceability: str,
    distance_mm: float,
) -> Iterator[Block]:
    """Everything that is to be said of the uncertainty of a span's rows."""
    yield Heading("Statement of uncertainty")
    yield Text(
        "After the Guide to the expression of uncertainty in measurement (GUM, JCGM 100) and "
        "EA-4/02."
    )
    yield from _traceability(traceability)
    if isinstance(statement, str) or good is None:
        reason = statement if isinstance(statement, str) else "the span has no good row"
        yield Text(f"No budget: {reason}.")
        return
    yield from _measurand(statement, distance_mm)
    yield from _result(statement, good, when)
    yield from _budget(statement)
    yield from _check(statement)
    yield from _conditions(statement, when)
    yield Heading("What the budget does not cover", 3)
    yield Bullets(_NOT_COVERED)
    yield Heading("Identification", 3)
    yield table(
        ("what", "version or number", "SHA-256"),
        (
            ("software that wrote this report", made_by(), software_hash()),
            (
                "software that measured the row",
                statement.record.version,
                "as above if the version is",
            ),
            ("config of the row", _same(statement), statement.record.config_hash),
            ("calibration", statement.calibration.id, calibration_hash(statement.calibration)),
        ),
    )


def _same(statement: Statement) -> str:
    return (
        "as now" if statement.is_config_of_row else "it has changed since; the budget is by today's"
    )


def _traceability(text: str) -> Iterator[Block]:
    yield Heading("Traceability", 3)
    yield Text(
        "This is no calibration certificate. Every length rests on two that the config gives: the "
        "distances between the discs of the main target and the side of the board's squares. "
        "The result is traceable to the SI only if both were measured with a calibrated length "
        "standard. "
        + (f"Declared by the operator: {text}" if text else "No such measurement is declared here.")
    )


def _measurand(statement: Statement, distance_mm: float) -> Iterator[Block]:
    datum, created = statement.datum, statement.calibration.id
    zero = "its calibration is the record's first, whose reference is the zero"
    if datum is not None and datum.steps:
        zero = f"the reference of calibration {created} in the record's zero: {datum.detail}"
    yield Heading("Measurand and model", 3)
    yield Text(
        "Measurand: the displacement (x to the right, y up, as the main camera sees it) of the "
        "main "
        f"target, {distance_mm / 1000.0:.3g} m away, relative to the board on the pier, in the "
        "plane of "
        f"the target, at the slot's time, counted from the record's zero. Datum: {zero}."
    )
    yield Formula("d = B⁻¹ (u − u₀ − uf(R, T; rig, lens, board) − s) − G c + d₀")
    yield Text(
        "u: mean place of the discs in the image, u₀: in the reference; uf: the shift that the "
        "rig's "
        "motion (R, T), seen by the sub-camera, makes of it; s: change of the rig since the "
        "reference, "
        "estimate 0; B: scale in px/mm, turned with the camera; c: what the fixed targets show "
        "of the "
        "rig's error, with the gain G (none without such targets); d₀: datum of the "
        "calibration. Raw, "
        "false and corrected displacement: docs/method.md."
    )


def _result(
    statement: Statement, good: GoodRows, when: Callable[[datetime], str]
) -> Iterator[Block]:
    yield Heading("Result", 3)
    yield Text(
        f"Of {good.rows} good rows the one with the median sigma stands for the span: "
        f"{when(statement.record.slot_utc)}."
    )
    lines = []
    for axis, name in _AXES:
        expanded = statement.budget.expanded(axis)
        row_mm = math.sqrt(float(statement.value.covariance_mm2[axis, axis]))
        value, u_text = two_digits(
            float(statement.value.mm[axis]), expanded.coverage_factor * row_mm
        )
        lines.append(
            (
                name,
                f"({value} ± {u_text}) mm",
                f"{expanded.coverage_factor:.2f}",
                f"{100 * COVERAGE:.2f} %",
                _freedom(expanded.degrees_of_freedom),
                f"{row_mm:.3g}",
                f"{expanded.combined_mm:.3g}",
            )
        )
    header = ("", "value ± U", "k", "coverage", "ν eff", "u of the row, mm", "u of the budget, mm")
    yield table(header, lines, (2, 3, 4, 5, 6))
    k = max(statement.budget.expanded(axis).coverage_factor for axis, _ in _AXES)
    texts = [
        two_digits(0.0, k * mm)[1]
        for mm in (good.median_sigma_mm, good.p95_sigma_mm, good.largest_sigma_mm)
    ]
    yield Text(
        "U is the standard uncertainty times the coverage factor k, which for a t distribution "
        "with "
        "ν eff effective degrees of freedom (Welch-Satterthwaite) gives a coverage probability of "
        f"about 95 %. Over the span U of a row, the worse axis, is {texts[0]} mm in the median, "
        "up to "
        f"{texts[1]} mm in 95 % of the good rows, {texts[2]} mm at most; each row carries its "
        "own sigma."
    )


def _budget(statement: Statement) -> Iterator[Block]:
    budget = statement.budget
    for axis, name in reversed(_AXES):
        expanded = budget.expanded(axis)
        lines = [_line(one, axis) for one in budget.inputs if one.factor_mm is None]
        joint = math.sqrt(float(budget.calibration_mm2[axis, axis]))
        lines += [_line(one, axis) for one in budget.correlated]
        lines += [
            ("calibration: these together, correlated", "", "", "", "", "", f"{joint:.2g}", "∞"),
            (
                "displacement",
                f"{statement.value.mm[axis]:.4f} mm",
                "",
                "",
                "",
                "",
                f"{expanded.combined_mm:.2g}",
                _freedom(expanded.degrees_of_freedom),
            ),
        ]
        yield Heading(f"Budget of {name}", 3)
        yield table(
            ("quantity", "estimate", "u(xᵢ)", "type", "distribution", "|cᵢ|", "uᵢ, mm", "ν"),
            lines,
            (2, 5, 6, 7),
        )
    yield Text(
        "Inputs in mm are vectors (a pose, all corners of the board); their covariance was carried "
        "through the complete derivatives, and u(xᵢ) is given as it acts on the displacement. "
        "Estimates of 0 are corrections that are not made. The lines of the calibration are of one "
        "adjustment, type A, with survey and drawing as prior, type B; its degrees of freedom, "
        "thousands, count as infinite. u of the stability budget is an estimate, taken to be "
        "known to "
        f"{100 * RELIABILITY:.0f} %: {_freedom(0.5 / RELIABILITY**2)} degrees of freedom (GUM "
        "G.4.2)."
    )
    yield Text("Correlation coefficients of the calibration's lines, for y:")
    names = [one.name for one in budget.correlated]
    matrix = budget.correlations(1)
    yield table(
        ("", *(str(k + 1) for k in range(len(names)))),
        [
            (f"{k + 1}  {name}", *(f"{value:+.2f}" for value in row))
            for k, (name, row) in enumerate(zip(names, matrix, strict=True))
        ],
        tuple(range(1, len(names) + 1)),
    )


def _line(one: Input, axis: int) -> tuple[str, ...]:
    u, c = one.standard_uncertainty(axis), one.sensitivity(axis)
    is_own = one.u is None
    return (
        one.name,
        "0" if one.evaluation == "B" else "as measured",
        f"{u:.2g} {one.unit}",
        one.evaluation,
        one.distribution,
        "1" if is_own else f"{c:.2g} mm per {one.unit}",
        f"{one.contribution_mm(axis):.2g}",
        _freedom(one.degrees_of_freedom),
    )


def _freedom(degrees: float) -> str:
    return "∞" if math.isinf(degrees) else f"{degrees:.0f}"


def _check(statement: Statement) -> Iterator[Block]:
    yield Heading("Checks of the budget", 3)
    worst = float(np.abs(statement.difference).max())
    sentences = [
        "The budget comes to the standard uncertainty that the row carries within "
        f"{100 * worst:.1f} %. "
        + ("" if worst <= AGREEMENT else "That is more than 5 %: the row's own U is stated above.")
    ]
    drawn = statement.drawn
    if drawn is None:
        sentences.append(
            "No Monte Carlo was made: there is none for the paper's method, or it was not asked "
            "for."
        )
    else:
        ratios = ", ".join(
            f"{name} {sigma:.3f} (interval {interval:.3f})"
            for (_, name), sigma, interval in zip(
                _AXES, drawn.ratio, drawn.interval_ratio, strict=True
            )
        )
        sentences.append(
            f"Monte Carlo after JCGM 101, {drawn.trials} trials: all inputs drawn at once from "
            "normal "
            "distributions, the pose of the board fitted again in each trial, the model without "
            f"linearisation. Standard deviation over the budget's: {ratios}; statistical error "
            "of the "
            f"ratio {100 * drawn.statistical:.1f} %. "
            + (
                "They agree within 5 %."
                if drawn.agrees
                else "They do NOT agree within 5 %: the budget is not validated."
            )
        )
    yield Bullets(tuple(sentences))


def _conditions(statement: Statement, when: Callable[[datetime], str]) -> Iterator[Block]:
    record, diagnostics = statement.record, statement.record.measurement.diagnostics
    days = expected_span(statement)
    facts: list[tuple[str, str]] = [
        ("slot", when(record.slot_utc)),
        ("pairs that the value rests on", str(record.measurement.frames_used)),
        ("discs found, corners used", f"{diagnostics.discs_found}, {diagnostics.corners_used}"),
        ("scale", f"{statement.budget.scale_px_per_mm:.3f} px/mm"),
        ("rig's motion since the reference", _motion(record)),
    ]
    if days is not None:
        facts.append(("time since the reference", f"{days:.1f} d"))
    for name, camera in (("main", record.main_camera), ("sub", record.sub_camera)):
        if camera.temperature_c is not None:
            facts.append((f"temperature of the {name} camera", f"{camera.temperature_c:.1f} °C"))
    facts += [
        (one.name, f"{one.value:.4g} {one.unit}")
        for one in record.readings
        if one.value is not None
    ]
    yield Heading("Conditions", 3)
    yield table(("what", "value"), facts)


def _motion(record: MeasurementRecord) -> str:
    motion = record.measurement.motion
    if motion is None:
        return ""
    turns: Sequence[float] = (1e3 * motion.rotation_rad).tolist()
    shifts: Sequence[float] = motion.translation_mm.tolist()
    return (
        f"{', '.join(f'{one:+.3f}' for one in turns)} mrad; "
        f"{', '.join(f'{one:+.3f}' for one in shifts)} mm"
    )
