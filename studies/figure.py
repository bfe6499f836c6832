"""Figures of the studies, drawn without a screen."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

COLOURS = ("#c0504d", "#1f5fa8", "#7f7f7f", "#3a8f4d")
"""The paper's way, ours, the truth, and a fourth."""


def new_figure(
    width: float, height: float, *, rows: int = 1, columns: int = 1, sharex: bool = False
) -> tuple[Figure, Any]:
    """Give a figure (inches) and its panels, a flat array."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, sharex=sharex, squeeze=False)
    return figure, np.ravel(panels)
