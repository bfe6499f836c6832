"""What dcam costs: time per pair and memory over many slots. Run with `make bench`."""

import daemon  # noqa: F401 - before numpy: it settles how many threads a matrix gets
