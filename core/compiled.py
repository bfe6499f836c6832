"""Loops compiled by Numba, and kept on disk as long as that works: it saves time, and nothing else.

Numba's own cache stops a program where it cannot write, where the disk is full, and where a power
cut has left a file of it damaged. And it compiles a function again only when that function's own
file has changed, though the compiled code holds the functions and constants of other files too.
Ours does without what it cannot read or write, and knows a loop by all that is compiled into it
(docs/decisions/0017).

>>> @compiled
... def sum_of_squares(values):
...     total = 0.0
...     for value in values:
...         total += value * value
...     return total
>>> sum_of_squares(np.array([3.0, 4.0]))
25.0
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Iterator
from contextlib import suppress
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.serialize import dumps

Loop = TypeVar("Loop", bound=Callable[..., Any])


class _CheckedFiles(CompileResultCacheImpl):
    """What Numba writes and reads, with a checksum: damaged machine code must not run."""

    def reduce(self, data: Any) -> tuple[bytes, bytes]:
        code: bytes = dumps(super().reduce(data))  # type: ignore[no-untyped-call]
        return hashlib.sha256(code).digest(), code

    def rebuild(self, target_context: Any, reduced_data: tuple[bytes, bytes]) -> Any:
        checksum, code = reduced_data
        if hashlib.sha256(code).digest() != checksum:
            msg = "damaged file in the cache of compiled loops"
            raise ValueError(msg)
        # Our own file, as safe as the programs beside it: Numba reads it in the same way.
        return super().rebuild(target_context, pickle.loads(code))  # type: ignore[no-untyped-call]  # noqa: S301


class _LoopCache(FunctionCache):
    """Numba's cache of one function; what cannot be read or written there is compiled again."""

    _impl_class = _CheckedFiles

    def __init__(self, loop: Any) -> None:
        super().__init__(loop.py_func)  # type: ignore[no-untyped-call]
        self._loop = loop

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        """Add to Numba's key what else the machine code is made of."""
        content = hashlib.sha256()
        for part in _content(self._loop, set()):
            content.update(part)
        return (*super()._index_key(sig, codegen), content.hexdigest())  # type: ignore[no-untyped-call]

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception:  # noqa: BLE001 - damaged, it is whatever unpickling then makes of it
            self._remove_damaged()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except Exception:  # noqa: BLE001 - the disk is full, or the index damaged
            self._remove_damaged()

    def _remove_damaged(self) -> None:
        """Empty the index: a damaged file would be in the way of what is compiled now."""
        with suppress(OSError):
            self.flush()  # type: ignore[no-untyped-call]


def _content(function: Any, seen: set[int]) -> Iterator[bytes]:
    """All that is compiled into a function: options, code, callees, and constants they name."""
    if id(function) in seen:
        return
    seen.add(id(function))
    options = getattr(function, "targetoptions", {})  # of a loop, not of a plain function
    yield repr([(name, _plain(options[name])) for name in sorted(options)]).encode()
    plain: FunctionType = getattr(function, "py_func", function)
    yield from _code(plain.__code__)
    for name in sorted(_global_names(plain.__code__)):
        value = plain.__globals__.get(name)
        if isinstance(getattr(value, "py_func", value), FunctionType):
            yield from _content(value, seen)
        elif isinstance(value, np.ndarray):
            yield value.tobytes()
        elif not isinstance(value, (ModuleType, type)):  # libraries: Numba's key has its version
            yield f"{name}={value!r}".encode()


def _code(code: CodeType) -> Iterator[bytes]:
    yield code.co_code
    yield repr(code.co_names).encode()
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code(constant)
        else:
            yield repr(constant).encode()


def _global_names(code: CodeType) -> set[str]:
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*(_global_names(each) for each in inner))


def _plain(option: Any) -> Any:
    """Sets have no order: it differs from process to process."""
    return sorted(option) if isinstance(option, (set, frozenset)) else option


def kept_on_disk(**options: Any) -> Callable[[Loop], Loop]:
    """Give a decorator: Numba's `njit` with these options, and its cache as far as that works."""
    compiler = njit(**options)

    def decorate(function: Loop) -> Loop:
        dispatcher: Any = compiler(function)
        with suppress(RuntimeError, OSError):  # nowhere to write
            # As its enable_caching() does.
            dispatcher._cache = _LoopCache(dispatcher)  # noqa: SLF001
        return dispatcher  # type: ignore[no-any-return]

    return decorate


def part_of_loops(**options: Any) -> Callable[[Loop], Loop]:
    """Give a decorator for what loops call: it becomes part of each, and is not kept by itself.

    Left to itself, Numba has a callee twice, optimized alone and within its caller. A process that
    compiles the caller runs the one, a process that reads the caller from the cache the other, and
    the last digits of a sum differ: a row could not be made once more to the last bit.
    """
    return cast("Callable[[Loop], Loop]", njit(forceinline=True, **options))


_OPTIONS = {
    "nogil": True,
    "error_model": "numpy",
    "boundscheck": False,
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
}

compiled = kept_on_disk(**_OPTIONS)
"""For the loops of core that Python calls. Sums may be reordered, so that they run on vector units;
NaN and infinity stay exact."""

inner_loop = part_of_loops(**_OPTIONS)
"""For what the loops of core call, and Python does not."""
