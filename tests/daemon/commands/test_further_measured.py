"""Further targets from images to rows: calibrated, reprocessed, and recorded by dcamd."""

from __future__ import annotations

import csv
import io
import json
import shutil
from contextlib import closing
from pathlib import Path

import pytest

from daemon.calibration.reference import take_reference
from daemon.config.reading import find_installation, load_config
from daemon.devices import open_clock, open_simulated_rig
from daemon.main import serve
from daemon.store.database import open_store_readonly
from tests.daemon.commands.conftest import FURTHER, HIDDEN_MIN, RUNNING, SIMULATED, Ctl, rows_of


def test_reprocess_appends_the_closure_and_each_target(
    further: Path, ctl: Ctl, tmp_path: Path
) -> None:
    """The measured one moves half as far as the bridge; the fixed one is hidden in the last."""
    ran = ctl(
        *("--config", further / "dcam.toml", "--state", further / "state", "reprocess"),
        *("--from", further / "set", "--output", tmp_path / "a.csv", "--json"),
    )
    assert ran.code == 0, ran.err
    rows = rows_of(tmp_path / "a.csv")
    assert list(rows[0])[15:] == [
        *("sigma_image_x_mm", "sigma_image_y_mm", "closure_x_mm", "closure_y_mm"),
        *("span-2_flag", "span-2_x_mm", "span-2_y_mm", "span-2_sigma_x_mm", "span-2_sigma_y_mm"),
        *("abutment_flag", "abutment_x_mm", "abutment_y_mm"),
        *("abutment_sigma_x_mm", "abutment_sigma_y_mm"),
    ]
    truth = [row for row in rows_of(further / "set" / "truth.csv") if row["role"] == "measure"]
    for row, true in zip(rows, truth, strict=True):
        assert row["span-2_flag"] == "1"
        for axis in "xy":
            true_mm = float(true[f"{axis}_mm"])
            assert abs(float(row[f"{axis}_mm"]) - true_mm) < 0.3
            assert abs(float(row[f"span-2_{axis}_mm"]) - 0.5 * true_mm) < 0.2
            assert float(row[f"sigma_image_{axis}_mm"]) <= float(row[f"sigma_{axis}_mm"])
    *seen, hidden = rows
    for row in seen:
        assert row["abutment_flag"] == "1"
        assert abs(float(row["closure_x_mm"])) < 0.3
        assert row["closure_y_mm"] == row["abutment_y_mm"]
    assert hidden["abutment_flag"] == "4"
    assert {hidden[f"abutment_{key}"] for key in ("x_mm", "y_mm", "sigma_x_mm")} == {""}
    assert (hidden["closure_x_mm"], hidden["closure_y_mm"]) == ("", "")
    assert float(hidden["sigma_x_mm"]) > 5 * float(seen[-1]["sigma_x_mm"])
    assert float(hidden["sigma_x_mm"]) > 1.5 * float(hidden["sigma_image_x_mm"])
    last = json.loads(ran.out)["rows"][-1]["targets"]
    assert [(one["name"], one["reasons"]) for one in last] == [
        ("span-2", []),
        ("abutment", ["target_not_found"]),
    ]


def test_a_zero_that_does_not_show_a_target_says_so(tmp_path: Path) -> None:
    """The other one is measured by such a calibration; nobody else would notice before winter."""
    text = SIMULATED.replace("[simulation]", f"{FURTHER}\n[simulation]") + RUNNING
    hidden = f"hidden_min = {[list(span) for span in HIDDEN_MIN]}"
    (tmp_path / "dcam.toml").write_text(text.replace(hidden, "hidden_min = [[0.0, 1e6]]"))
    config = load_config(tmp_path / "dcam.toml")
    clock = open_clock(config)
    troubles: list[str] = []
    with closing(open_simulated_rig(config, clock).source) as source:
        take_reference(source, clock, config.site(), troubles.append)
    (trouble,) = troubles
    assert trouble.startswith('zero: target "abutment" is not seen')


def test_dcamd_records_each_target_and_status_export_and_capture_show_it(
    further: Path, ctl: Ctl, tmp_path: Path
) -> None:
    shutil.copytree(further / "state", tmp_path / "state")
    config = tmp_path / "dcam.toml"
    config.write_text(SIMULATED.replace("[simulation]", f"{FURTHER}\n[simulation]") + RUNNING)
    serve(find_installation(config, tmp_path / "state"), max_slots=3)
    base = ("--config", config, "--state", tmp_path / "state")
    with open_store_readonly(tmp_path / "state") as store:
        rows = list(store.measurements())
    named = [[target.name for target in row.measurement.targets] for row in rows]
    assert named == [["span-2", "abutment"]] * 3
    assert [row.measurement.closure is None for row in rows] == [False, False, True]
    exported = list(csv.DictReader(io.StringIO(ctl(*base, "export").out)))
    assert [row["abutment_flag"] for row in exported] == ["1", "1", "4"]
    assert exported[2]["abutment_reasons"] == "target_not_found"
    for row, stored in zip(exported, rows, strict=True):
        corrected = stored.measurement.targets[0].corrected
        assert corrected is not None
        assert float(row["span-2_y_mm"]) == pytest.approx(corrected.mm[1], abs=1e-6)
    at = rows[-1].slot_utc.isoformat()
    said = " ".join(ctl(*base, "status", "--at", at).out.split())
    assert "target abutment ok" in said
    assert "fixed, no value (bad: target_not_found), last value 1 min ago" in said
    assert " mm over 30 d, sigma " in said
    looked = ctl(*base, "capture").out
    assert "span-2       measured, x " in looked
    assert "abutment     fixed, " in looked
