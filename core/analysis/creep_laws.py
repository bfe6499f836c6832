"""The usual laws of creep after loading: their curves, and what bends them.

Sources: EN 1992-1-1:2004 (B.7); ACI 209R-92, section 2.4; Bazant & Osman, Cem. Concr. Res. 6 (1976)
for the power law; Kelvin chain of two elements for the double exponential; Bazant & Baweja, Mater.
Struct. 28 (1995) 357 for B3, basic creep and drying creep.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from core.arrays import FloatArray

_CODE_EXPONENT = 0.3
"""Of EN 1992-1-1 (B.7)."""
_BASIC_EXPONENT = 0.1
"""Of B3's basic creep."""
_DRYING = 8.0
"""Of B3's drying creep."""


class Law(StrEnum):
    """The usual laws of creep."""

    LOGARITHMIC = "logarithmic"
    POWER = "power"
    DOUBLE_EXPONENTIAL = "double-exponential"
    EUROCODE = "eurocode2"
    ACI = "aci209"
    B3 = "b3"


@dataclass(frozen=True, slots=True)
class ShapeParameter:
    """What bends a law's curve, equally likely between its bounds beforehand."""

    name: str
    low: float
    high: float
    by_ratio: bool = False
    """Equally likely by its logarithm."""

    def at(self, place: FloatArray) -> FloatArray:
        """Its values (n,) at places from 0 to 1."""
        if self.by_ratio:
            return self.low * (self.high / self.low) ** place
        return self.low + (self.high - self.low) * place


SHAPES: dict[Law, tuple[ShapeParameter, ...]] = {
    Law.LOGARITHMIC: (ShapeParameter("time_days", 0.1, 100.0, by_ratio=True),),
    Law.POWER: (ShapeParameter("exponent", 0.03, 1.0),),
    Law.DOUBLE_EXPONENTIAL: (
        ShapeParameter("fast_days", 0.5, 40.0, by_ratio=True),
        ShapeParameter("slow_days", 40.0, 2000.0, by_ratio=True),
    ),
    Law.EUROCODE: (ShapeParameter("beta_h_days", 250.0, 1500.0),),  # (B.8): up to 1500
    Law.ACI: (
        ShapeParameter("exponent", 0.4, 0.8),
        ShapeParameter("time", 6.0, 30.0),  # the bounds that ACI 209 names
    ),
    Law.B3: (
        ShapeParameter("drying_days", 30.0, 3000.0, by_ratio=True),
        ShapeParameter("humidity", 0.4, 0.9),
    ),
}
"""By law; the bounds are physical ones."""


def curves(law: Law, days: FloatArray, shapes: FloatArray) -> FloatArray:
    """(k, n, curves) courses of a law `days` (n,) after loading, of shapes (k, parameters).

    0 before loading.

    >>> curves(Law.POWER, np.array([0.0, 100.0]), np.array([[0.5]])).ravel().tolist()
    [0.0, 10.0]
    """
    since = np.maximum(days, 0.0)[:, None]
    bent = shapes[:, None, :]  # (k, 1, parameters)
    found: FloatArray
    match law:
        case Law.LOGARITHMIC:
            found = np.log1p(since / bent)
        case Law.POWER:
            found = since**bent
        case Law.EUROCODE:
            found = (since / (bent + since)) ** _CODE_EXPONENT
        case Law.ACI:
            grown = since ** bent[..., :1]
            found = grown / (bent[..., 1:] + grown)
        case Law.B3:
            dried = _DRYING * (1.0 - bent[..., 1:]) * np.tanh(np.sqrt(since / bent[..., :1]))
            basic = np.broadcast_to(np.log1p(since**_BASIC_EXPONENT), dried.shape)
            found = np.concatenate([basic, np.sqrt(np.expm1(dried))], axis=-1)
        case Law.DOUBLE_EXPONENTIAL:
            found = -np.expm1(-since / bent)
    return found
