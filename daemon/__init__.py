"""The field software: schedule, pipeline, store, recovery and commands."""

import os

from daemon.loop_cache import loop_cache

# Our matrices have a few hundred rows. Threads that share such work wait for one another, spinning:
# a calibration takes five times as long where another program wants the second core, and the other
# program suffers. Read by numpy's and scipy's OpenBLAS when first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# No other package's plug-in has a say in our config; to look for them takes longer than to read it.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
# Read by Numba when first imported.
if directory := loop_cache():
    os.environ["NUMBA_CACHE_DIR"] = directory
