"""Log lines: key=value or JSON on stderr, with our logger names, never on stdout."""

import io
import json
import logging

import pytest
import structlog

from daemon.log import configure_log


@pytest.fixture(autouse=True)
def _log_as_before():
    root = logging.getLogger()
    before = root.handlers, root.level
    yield
    root.handlers, root.level = before
    structlog.reset_defaults()


def test_keyvalue_line_has_time_level_logger_event_first() -> None:
    stream = io.StringIO()
    configure_log("keyvalue", "info", stream, environ={})
    structlog.get_logger("dcam.daemon").info("slot_done", slot="2026-03-01T00:00:00Z", x_mm=1.5)
    structlog.get_logger("dcam.drivers").debug("not wanted at this level")
    (line,) = stream.getvalue().splitlines()
    assert line.startswith("time=")
    assert line.endswith(
        "level=info logger=dcam.daemon event=slot_done slot=2026-03-01T00:00:00Z x_mm=1.5"
    )


def test_json_line_is_an_object() -> None:
    stream = io.StringIO()
    configure_log("json", "debug", stream, environ={})
    structlog.get_logger("dcam.drivers").debug("camera_open", serial="1", path=io)
    event = json.loads(stream.getvalue())
    assert (event["logger"], event["event"], event["serial"]) == (
        "dcam.drivers",
        "camera_open",
        "1",
    )


def test_libraries_speak_from_warning_on_and_in_the_same_form() -> None:
    stream = io.StringIO()
    configure_log("keyvalue", "debug", stream, environ={})
    logging.getLogger("alembic").info("chatter")
    logging.getLogger("alembic").warning("trouble with %s", "it")
    (line,) = stream.getvalue().splitlines()
    assert 'level=warning logger=alembic event="trouble with it"' in line


def test_exception_stays_on_one_line() -> None:
    stream = io.StringIO()
    configure_log("keyvalue", "info", stream, environ={})
    try:
        int("deep")
    except ValueError:
        structlog.get_logger("dcam.daemon").exception("slot_failed")
    (line,) = stream.getvalue().splitlines()
    assert "ValueError: invalid literal" in line


def test_a_control_character_is_shown_and_not_obeyed() -> None:
    """A camera may give any name."""
    stream = io.StringIO()
    configure_log("keyvalue", "info", stream, environ={})
    structlog.get_logger("dcam.daemon").info("camera_open", name="a\x1b[2J\x9bm\rb")
    assert "\\x1b[2J\\x9bm" in stream.getvalue()
    assert not [sign for sign in stream.getvalue()[:-1] if not sign.isprintable()]


def test_journal_gets_the_priority_before_the_line() -> None:
    stream = io.StringIO()
    configure_log("keyvalue", "info", stream, environ={"JOURNAL_STREAM": "8:1"})
    structlog.get_logger("dcam.daemon").error("disk_full")
    assert stream.getvalue().startswith("<3>time=")


def test_nothing_goes_to_stdout(capsys) -> None:
    configure_log()
    structlog.get_logger("dcam.daemon").warning("seen")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "event=seen" in captured.err
