"""A second measurement confirms an alarm, holds it back for a while, or cannot be had."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from daemon.alarm import confirmation
from daemon.control.camera_lease import CameraLease
from daemon.control.control_socket import CommandHandlers, control_socket
from daemon.errors import HardwareError
from daemon.store.queries.json_fields import result_fields
from tests.daemon.alarm.conftest import LOW, Program, configure, history, look, row
from tests.daemon.commands.conftest import MINUTE, START, Site

CONFIRM = f"{LOW}confirm = true\n"


def answering(state: Path, capture: Callable[[], dict[str, Any]]) -> Any:
    """The control socket of a dcamd whose cameras see this."""
    return control_socket(state, CameraLease(), CommandHandlers(capture, lambda: None))


def sees(y_mm: float) -> Callable[[], dict[str, Any]]:
    fields = result_fields(START, row(y_mm, 0.12))
    return lambda: {"measurement": {**fields, "slot_utc": "2026-03-01T00:15:31Z"}}


def test_a_second_measurement_confirms(site: Site, program: Program) -> None:
    configure(site, f"command = {program.command}\n{CONFIRM}")
    site.measure(5, row(-11.0))
    with answering(site.state, sees(-11.2)):
        look(site)
    (message,) = program.messages()
    said = "confirmed by a second measurement of 2026-03-01T00:15:31Z: -11.200 ± 0.120 mm"
    assert said in message


def test_what_it_contradicts_waits_for_two_looks_and_not_for_ever(
    site: Site, program: Program
) -> None:
    configure(site, f"command = {program.command}\n{CONFIRM}")
    site.measure(5, row(-11.0))
    with answering(site.state, sees(0.0)):
        look(site)
        look(site)
        assert program.messages() == []
        look(site)
    (message,) = program.messages()
    assert "contradicted by a second measurement" in message
    assert [one["kind"] for one in history(site)][:3] == ["contradicted", "contradicted", "raised"]


def no_room() -> dict[str, Any]:
    msg = "there was no time for it between two slots"
    raise HardwareError(msg)


def test_without_a_second_measurement_it_goes_out_as_unconfirmed(
    site: Site, program: Program
) -> None:
    configure(site, f"command = {program.command}\n{CONFIRM}")
    site.measure(5, row(-11.0))
    with answering(site.state, no_room):
        look(site)
    (message,) = program.messages()
    assert "unconfirmed: dcamd: there was no time for it between two slots" in message


def test_with_no_dcamd_it_goes_out_as_unconfirmed(site: Site, program: Program) -> None:
    configure(site, f"command = {program.command}\n{CONFIRM}")
    site.measure(5, row(-11.0))
    look(site)
    assert "unconfirmed: no dcamd runs" in program.messages()[0]


def test_one_that_never_answers_is_left_after_a_bound(
    site: Site, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    import threading

    monkeypatch.setattr(confirmation, "BOUND_S", 0.3)
    configure(site, f"command = {program.command}\n{CONFIRM}")
    site.measure(5, row(-11.0))
    release = threading.Event()

    def hang() -> dict[str, Any]:
        release.wait()
        return {}

    with answering(site.state, hang):
        look(site)
        release.set()
    assert "unconfirmed: no second measurement within" in program.messages()[0]
    look(site, late=MINUTE)
    assert len(program.messages()) == 1
