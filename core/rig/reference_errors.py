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
"""(2, 4) by a fixed target's name: so much of its shift (mm), turn (rad) and relative change of
scale is taken off a displacement."""

_SHIFT, _FIXED = 2, 4
"""Values of a target: its shift, and of a fixed one its turn and change of scale too."""


@dataclass(frozen=True, slots=True)
class ReferenceErrors:
    """Errors of where the targets are at a reference, as a joint covariance.

    A displacement measured from the reference is wrong by their negative, one measured of the
    reference by themselves.
    """

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    """Of the values below, for each target: shift (2, mm) and, of a fixed one, turn (rad) and
    relative change of scale."""
    covariance: FloatArray
    """(m, m)."""

    def by_values(self, target: str, gains: Gains) -> FloatArray | None:
        """(2, m): a target's displacement by these errors, with what fixed ones show taken off.

        None of a target that the reference does not show.
        """
        if target not in self.names:
            return None
        parts = [
            np.eye(_SHIFT, size) if name == target else self._taken(name, size, gains)
            for name, size in zip(self.names, self.sizes, strict=True)
        ]
        return np.concatenate(parts, axis=1)

    def places(self, targets: Sequence[str]) -> IntArray:
        """Indices of all values of some targets, in their order."""
        ends = dict(zip(self.names, np.cumsum(self.sizes).tolist(), strict=True))
        sizes = dict(zip(self.names, self.sizes, strict=True))
        return np.concatenate([np.arange(ends[n] - sizes[n], ends[n]) for n in targets])

    @property
    def has_fixed(self) -> bool:
        """Whether a fixed target is among them."""
        return _FIXED in self.sizes

    @staticmethod
    def _taken(name: str, size: int, gains: Gains) -> FloatArray:
        gain = gains.get(name)
        usable = gain is not None and size == _FIXED
        return -np.asarray(gain) if usable else np.zeros((_SHIFT, size))
