"""What a local cluster's workers have in common: imported in the one process they are forked from.

Each would otherwise import it by itself, two seconds of processor time at every start.
"""

from __future__ import annotations

import signal

import distributed.nanny  # noqa: F401 - workers run in it
import numpy as np

import daemon.reprocessing.chunks  # noqa: F401 - what workers do
from core.geometry.lens import Lens
from core.lens_model import LensModel

# Ctrl-C reaches all processes of a terminal; the run ends its workers by itself.
signal.signal(signal.SIGINT, signal.SIG_IGN)
# The first loop has Numba set itself up, 0.3 s.
Lens.ideal(LensModel.RADIAL, 1.0, (0.0, 0.0)).project(np.ones((1, 3)))
