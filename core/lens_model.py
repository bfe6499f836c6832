"""The closed family of lens distortions, by name."""

from __future__ import annotations

from enum import StrEnum


class LensModel(StrEnum):
    """The distortions there are, the one with the fewest coefficients first."""

    RADIAL = "radial"
    """Brown (1971), symmetric: k1, k2."""
    FISHEYE = "fisheye"
    """Kannala and Brandt (2006): k1 to k4 in the angle from the axis; to 180 degrees and beyond."""
    BROWN = "brown"
    """Brown (1971) with decentring: k1, k2, p1, p2, k3 (OpenCV's five)."""
    RATIONAL = "rational"
    """A ratio of polynomials: k1, k2, p1, p2, k3, k4, k5, k6 (OpenCV's eight)."""

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the distortion's coefficients, in their order."""
        if self is LensModel.FISHEYE:
            return ("k1", "k2", "k3", "k4")
        many = {LensModel.RADIAL: 2, LensModel.BROWN: 5, LensModel.RATIONAL: 8}[self]
        return ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")[:many]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of all parameters, the intrinsics of Eq. 10 first.

        >>> LensModel.RADIAL.parameters
        ('alpha', 'beta', 'gamma', 'mu', 'nu', 'k1', 'k2')
        """
        return ("alpha", "beta", "gamma", "mu", "nu", *self.coefficients)
