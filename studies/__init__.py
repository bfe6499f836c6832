"""Studies of accuracy against the simulator's truth: `make studies`."""

import daemon  # noqa: F401 - numerics with one thread, before anything of NumPy is loaded
