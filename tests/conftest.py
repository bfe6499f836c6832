"""For all tests: numerics with one thread, as in our programs. Loaded before anything of numpy."""

from collections.abc import Callable

import pytest

import daemon  # noqa: F401

TALLY = "tally"


@pytest.fixture
def tally(record_property: Callable[[str, object], None]) -> Callable[[str], None]:
    """Have a line printed after all tests, also by the process that only collects the results."""
    return lambda line: record_property(TALLY, line)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = [
        report for kind in ("passed", "failed") for report in terminalreporter.getreports(kind)
    ]
    for report in reports:
        for name, line in report.user_properties:
            if name == TALLY:
                terminalreporter.write_line(line)
