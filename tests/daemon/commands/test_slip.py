"""A board that slips while dcamd runs: rows are suspect, also after a restart, until it is back."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from daemon.config.reading import find_installation
from daemon.main import serve
from daemon.store.database import open_store_readonly
from daemon.times import slot_text
from drivers.sim.world import World
from tests.daemon.commands.conftest import SIMULATED, Ctl, rows_of

SLOTS = 7


@pytest.fixture
def slipping(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Let the board of every world made from now on sit so many mm to the right."""

    def slip(x_mm: float) -> None:
        made = World.__init__

        def init(self: World, *arguments: object) -> None:
            made(self, *arguments)
            self.slip_board(x_mm, 0.0)

        monkeypatch.setattr("drivers.sim.world.World.__init__", init)

    return slip


def test_rows_of_a_slipped_board_stay_suspect_until_it_is_back(
    ctl: Ctl, calibrated: Path, tmp_path: Path, slipping: Callable[[float], None]
) -> None:
    shutil.copytree(calibrated, tmp_path / "state")
    (tmp_path / "dcam.toml").write_text(SIMULATED)
    site = find_installation(tmp_path / "dcam.toml", tmp_path / "state")
    serve(site, max_slots=SLOTS)
    slipping(4.0)
    serve(site, max_slots=2)
    serve(site, max_slots=1)
    status = ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state", "status").out
    assert "the board has slipped" in status
    slipping(0.0)
    serve(site, max_slots=2)
    with open_store_readonly(tmp_path / "state") as store:
        rows = list(store.measurements())
        told = [event.detail for event in store.events() if event.kind == "board_slipped"]
    said = ["+".join(row.measurement.reasons) for row in rows]
    assert said == [""] * SLOTS + ["board_slipped"] * 3 + [""] * 2
    assert len(told) == 1
    assert told[0].startswith(f"since {slot_text(rows[SLOTS].slot_utc)}, x ")
    again = tmp_path / "again.csv"
    site_flags = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
    assert ctl(*site_flags, "reprocess", "--output", again).code == 0
    assert [row["reasons"] for row in rows_of(again)] == said
