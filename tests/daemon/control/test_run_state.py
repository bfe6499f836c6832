"""What dcamd does now lies in memory: the disk of another state directory cannot fail it."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.control import run_state
from daemon.control.run_state import FILE_NAME, read_run_state, runtime_directory
from daemon.error_report import run
from daemon.main import cli
from tests.daemon.commands.conftest import SIMULATED


@pytest.mark.parametrize("is_service", [True, False])
def test_with_another_state_directory_it_is_in_memory_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_service: bool
) -> None:
    config, state, runtime = tmp_path / "dcam.toml", tmp_path / "state", tmp_path / "run"
    config.write_text(SIMULATED)
    if is_service:
        runtime.mkdir()
    words = ["--config", str(config), "--state", str(state), "--max-slots", "1"]
    monkeypatch.setattr(run_state, "RUNTIME_DIRECTORY", runtime)  # as systemd would have made it
    assert run(cli, "dcamd", words) == 0
    assert read_run_state(runtime_directory(state)) is not None
    assert (state / FILE_NAME).exists() != is_service
