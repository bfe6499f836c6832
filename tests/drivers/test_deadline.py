"""A call that blocks costs its caller the deadline and no more, and its thread ends by itself."""

from __future__ import annotations

import threading
import time
import weakref

import pytest

from drivers.deadline import DeadlineExceededError, DeadlineThread


class Held:
    """Stands for an object of the library."""


def test_a_call_gives_its_value_and_its_error() -> None:
    thread = DeadlineThread("test", at_end=lambda: None)
    assert thread.call(lambda: 7, 5.0) == 7
    with pytest.raises(ZeroDivisionError):
        thread.call(lambda: 1 // 0, 5.0)
    thread.end(5.0)
    assert not thread.alive


def test_a_time_out_of_the_call_itself_is_no_exceeded_deadline() -> None:
    def give_up() -> None:
        raise TimeoutError

    thread = DeadlineThread("test", at_end=lambda: None)
    with pytest.raises(TimeoutError):
        thread.call(give_up, 5.0)
    thread.end(5.0)


def test_a_blocked_call_costs_its_deadline_and_is_released_in_its_own_thread() -> None:
    let_go, released_in = threading.Event(), []
    thread = DeadlineThread(
        "test", at_end=lambda: released_in.append(threading.current_thread().name)
    )
    start_s = time.monotonic()
    with pytest.raises(DeadlineExceededError):
        thread.call(lambda: let_go.wait(30.0), 0.05)
    thread.end()
    assert time.monotonic() - start_s < 5.0
    assert thread.alive
    assert not released_in
    let_go.set()
    thread.end(5.0)
    assert not thread.alive
    assert released_in == ["test"]


def test_an_error_does_not_keep_the_objects_of_the_call_alive() -> None:
    seen: list[weakref.ref[Held]] = []

    def fail() -> None:
        held = Held()
        seen.append(weakref.ref(held))
        msg = "failed"
        raise ValueError(msg)

    thread = DeadlineThread("test", at_end=lambda: None)
    with pytest.raises(ValueError, match="failed") as caught:
        thread.call(fail, 5.0)
    thread.end(5.0)
    assert caught.value is not None
    assert seen[0]() is None
