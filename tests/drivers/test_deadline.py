"""A call that blocks costs its caller the deadline and no more, and its thread ends by itself."""

from __future__ import annotations

import threading
import weakref

import pytest

from drivers.deadline import DeadlineExceededError, DeadlineThread
from tests.waiting import PATIENCE_S


class Held:
    """Stands for an object of the library."""


def test_a_call_gives_its_value_and_its_error() -> None:
    thread = DeadlineThread("test", at_end=lambda: None)
    assert thread.call(lambda: 7, PATIENCE_S) == 7
    with pytest.raises(ZeroDivisionError):
        thread.call(lambda: 1 // 0, PATIENCE_S)
    thread.end(PATIENCE_S)
    assert not thread.alive


def test_a_time_out_of_the_call_itself_is_no_exceeded_deadline() -> None:
    def give_up() -> None:
        raise TimeoutError

    thread = DeadlineThread("test", at_end=lambda: None)
    with pytest.raises(TimeoutError):
        thread.call(give_up, PATIENCE_S)
    thread.end(PATIENCE_S)


def test_a_blocked_call_costs_its_deadline_and_is_released_in_its_own_thread() -> None:
    let_go, released_in = threading.Event(), []
    thread = DeadlineThread(
        "test", at_end=lambda: released_in.append(threading.current_thread().name)
    )
    with pytest.raises(DeadlineExceededError):
        thread.call(lambda: let_go.wait(PATIENCE_S), 0.05)
    thread.end(0.05)
    assert thread.alive
    assert not released_in
    let_go.set()
    thread.end(PATIENCE_S)
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
        thread.call(fail, PATIENCE_S)
    thread.end(PATIENCE_S)
    assert caught.value is not None
    assert seen[0]() is None
