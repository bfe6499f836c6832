"""The further targets of a row: one column of JSON, so that a row stays one thing.

A list of objects in the order of the config: `name`, `role`, `flag`, `reasons` joined by `+`, and
under the names of the row's own columns the corrected displacement and the raw one, as far as
there are any; of a fixed one `taken_off` too, eight numbers by the name of each target that its
error was taken off. Tables show them as columns of their own, the target's name before the key's.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from core.arrays import FloatArray
from core.results import Flag, Reason, TargetMeasurement
from core.site import TargetRole
from daemon.store.rows.displacements import corrected_columns, displacement_columns, displacement_of

TARGET_RESULT_COLUMNS = ("flag", "x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm")
"""What `reprocess` writes of each."""

TARGET_COLUMNS = (
    *("flag", "reasons", "x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm", "cov_xy_mm2"),
    *("sigma_image_x_mm", "sigma_image_y_mm", "cov_image_xy_mm2"),
    *("raw_x_mm", "raw_y_mm", "raw_sigma_x_mm", "raw_sigma_y_mm", "raw_cov_xy_mm2", "role"),
)
"""What `export` writes of each; all but the role are columns of the row, too."""


_DIGITS = 5
"""Of what was taken off: 1e-5 of it is nothing beside what it is multiplied with."""


def join_reasons(reasons: tuple[Reason, ...]) -> str:
    """Reasons as one word of a table."""
    return "+".join(reason.value for reason in reasons)


def split_reasons(text: str) -> tuple[Reason, ...]:
    """The reasons of a table's word."""
    return tuple(Reason(word) for word in text.split("+") if word)


def targets_text(targets: Sequence[TargetMeasurement]) -> str | None:
    """The column's text; None without any. Raises ValueError for what is not finite."""
    if not targets:
        return None
    found = [target_values(target) for target in targets]
    return json.dumps(found, allow_nan=False, separators=(",", ":"))


def targets_of(text: str | None) -> tuple[TargetMeasurement, ...]:
    """The targets of the column's text."""
    return tuple(
        TargetMeasurement(
            name=values["name"],
            role=TargetRole(values["role"]),
            flag=Flag(values["flag"]),
            reasons=split_reasons(values["reasons"]),
            corrected=displacement_of(values),
            raw=displacement_of(values, "raw_"),
            taken_off=_taken_off(values.get("taken_off")),
        )
        for values in stored_targets(text)
    )


def stored_targets(text: str | None) -> list[dict[str, Any]]:
    """The values of each target as they are stored, by key."""
    found: list[dict[str, Any]] = [] if text is None else json.loads(text)
    return found


def text_without_target(text: str | None, name: str) -> str:
    """The column's text without one of its targets."""
    left = [values for values in stored_targets(text) if values["name"] != name]
    return json.dumps(left, separators=(",", ":"))


def target_values(target: TargetMeasurement) -> dict[str, Any]:
    """A target's values by key, those that it does not have left out. Raises ValueError."""
    return {
        "name": target.name,
        "role": target.role.value,
        "flag": int(target.flag),
        "reasons": join_reasons(target.reasons),
        **corrected_columns(target.corrected),
        **displacement_columns(target.raw, "raw_"),
        **_taken_off_values(target.taken_off),
    }


def _taken_off_values(taken_off: Mapping[str, FloatArray] | None) -> dict[str, Any]:
    if taken_off is None:
        return {}
    rounded = {
        name: [float(f"{value:.{_DIGITS}g}") for value in np.ravel(gain)]
        for name, gain in taken_off.items()
    }
    return {"taken_off": rounded}


def _taken_off(values: Mapping[str, Sequence[float]] | None) -> dict[str, FloatArray] | None:
    if values is None:
        return None
    return {name: np.reshape(gain, (2, 4)) for name, gain in values.items()}


def gains_in(text: str | None, target: str) -> dict[str, FloatArray] | None:
    """What of fixed targets' values a row of this text had taken off a target.

    (2, 4) by the fixed one's name; None where that is not known, as in a text that is damaged.
    """
    try:
        fixed = [seen for seen in stored_targets(text) if seen["role"] == TargetRole.FIXED]
        if any("taken_off" not in seen for seen in fixed if "x_mm" in seen):
            return None
        taken = {seen["name"]: seen.get("taken_off", {}).get(target) for seen in fixed}
        return {name: np.reshape(gain, (2, 4)) for name, gain in taken.items() if gain is not None}
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


def target_of_column(column: str) -> tuple[str, str] | None:
    """The target and the key of a table's column; None of a column of the row itself."""
    name, _, key = column.partition("_")  # no name has such a line
    return (name, key) if key in TARGET_COLUMNS else None


def columns_of_target(name: str, keys: Iterable[str]) -> tuple[str, ...]:
    """The names that a target's values have in tables."""
    return tuple(f"{name}_{key}" for key in keys)


def values_of_targets(
    texts: Sequence[str | None], names: Sequence[str], keys: Sequence[str] = TARGET_COLUMNS
) -> dict[str, list[Any]]:
    """What many rows say of some further targets, as a table's columns; None where nothing."""
    if not names:
        return {}
    rows = [{found["name"]: found for found in stored_targets(text)} for text in texts]
    nothing: dict[str, Any] = {}
    return {
        column: [row.get(name, nothing).get(key) for row in rows]
        for name in names
        for key, column in zip(keys, columns_of_target(name, keys), strict=True)
    }
