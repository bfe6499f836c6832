"""Loops compiled by Numba, and kept on disk as long as that works: it saves time, and nothing else.

Numba itself gives up where it cannot write, where the disk is full, and where a power cut has left
a file of its cache empty: a program would not start again until somebody clears it away.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from numba import njit
from numba.core.caching import FunctionCache

Loop = TypeVar("Loop", bound=Callable[..., Any])


class _Keeper(FunctionCache):
    """Numba's cache of one function; what cannot be read or written there is compiled anew."""

    @contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:
        """Numba reads and writes within this, and has it let pass an error of Windows."""
        try:
            yield
        except Exception:  # noqa: BLE001 - damaged, it is whatever unpickling then makes of it
            with suppress(OSError):
                # A damaged file would be in the way of what is compiled now.
                self.flush()  # type: ignore[no-untyped-call]


def kept_on_disk(**options: Any) -> Callable[[Loop], Loop]:
    """Give a decorator: Numba's `njit` with these options, and its cache as far as that works."""
    compiler = njit(**options)

    def decorate(function: Loop) -> Loop:
        dispatcher: Any = compiler(function)
        with suppress(RuntimeError, OSError):  # nowhere to write
            # As its enable_caching() does.
            dispatcher._cache = _Keeper(function)  # type: ignore[no-untyped-call]  # noqa: SLF001
        return dispatcher  # type: ignore[no-any-return]

    return decorate


# Sums may be reordered (so that they run on vector units), but NaN and infinity stay exact.
compiled = kept_on_disk(
    nogil=True,
    error_model="numpy",
    boundscheck=False,
    fastmath={"contract", "reassoc", "nsz", "arcp"},
)
# A compiled function is kept with the functions that it calls in it, and is compiled anew when
# its own file changes: after a change here, clear __pycache__.
