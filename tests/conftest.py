"""For all tests: numerics with one thread, as in our programs. Loaded before anything of numpy."""

import daemon  # noqa: F401
