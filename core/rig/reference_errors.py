"""What the noise of a reference's own images does to all that is measured from it.

A row counts from the reference of its calibration, and so does a link of the datum that measured
this same reference: the noise of its images is in both, with opposite signs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray, IntArray

Gains = Mapping[str, FloatArray]
"""(2, 4) by a target's name: so much of its shift (mm), turn (rad) and relative change of scale is
taken off a displacement."""

_SHIFT, _VALUES = 2, 4
"""Values of a target: its shift; its turn and change of scale too."""


@dataclass(frozen=True, slots=True)
class ReferenceErrors:
    """Errors of where the targets are at a reference, as a joint covariance.

    A displacement measured from the reference is wrong by their negative, one measured of the
    reference by themselves.
    """

    names: tuple[str, ...]
    fixed: tuple[bool, ...]
    """Of each target: whether it is a fixed one."""
    covariance: FloatArray
    """(4 n, 4 n) of each target's shift (2, mm), turn (rad) and relative change of scale."""

    def by_values(self, target: str, gains: Gains) -> FloatArray | None:
        """(2, 4 n): a target's displacement by these errors, less what gains take off.

        None of a target that the reference does not show.
        """
        if target not in self.names:
            return None
        parts = [
            np.eye(_SHIFT, _VALUES, dtype=float) * (name == target)
            - gains.get(name, np.zeros((_SHIFT, _VALUES)))
            for name in self.names
        ]
        return np.concatenate(parts, axis=1)

    def places_in_row(self, targets: Sequence[str]) -> IntArray:
        """Indices of what a row uses of some targets: all of a fixed one, of others the shift."""
        found = []
        for target in targets:
            at = self.names.index(target)
            used = _VALUES if self.fixed[at] else _SHIFT
            found.append(np.arange(_VALUES * at, _VALUES * at + used))
        return np.concatenate(found)

    @property
    def has_fixed(self) -> bool:
        """Whether a fixed target is among them."""
        return any(self.fixed)
