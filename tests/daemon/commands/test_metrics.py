"""`dcam-ctl metrics`: Prometheus reads what `status` says, in base units."""

from __future__ import annotations

import json
import stat
from datetime import datetime
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from daemon.lock import sole_writer
from daemon.store.records import CameraState, GapCause
from tests.daemon.commands.conftest import DARK, MINUTE, Ran, Site
from tests.daemon.commands.imports import modules_of

Read = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def read(text: str) -> Read:
    """Every sample, by name and labels; none may come twice."""
    samples = [s for family in text_string_to_metric_families(text) for s in family.samples]
    found = {(s.name, tuple(sorted(s.labels.items()))): s.value for s in samples}
    assert len(found) == len(samples)
    return found


def value(found: Read, name: str, **labels: str) -> float:
    return found[f"dcam_{name}", tuple(sorted(labels.items()))]


def names(found: Read) -> set[str]:
    return {name.removeprefix("dcam_") for name, _labels in found}


def metrics(site: Site, *words: object) -> Ran:
    """Beside a daemon that holds the lock, half a minute after the last row as `status` is."""
    at = (site.end - MINUTE / 2).isoformat()
    with sole_writer(site.state):
        return site.ctl("metrics", "--at", at, *words)


def seconds(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def test_prometheus_reads_what_status_says(site: Site) -> None:
    site.miss(2, GapCause.CAMERA_LOST)
    site.measure(3)
    ran, status = metrics(site), json.loads(site.status().out)
    assert ran.code == 0, ran.err
    found = read(ran.out)
    assert value(found, "level") == status["code"]
    for item in status["items"]:
        level = ["ok", "warning", "critical", "unknown"].index(item["level"])
        assert value(found, "status_level", item=item["name"]) == level
    last = status["last"]
    for axis in ("x", "y"):
        for name, key in (
            ("displacement_metres", f"{axis}_mm"),
            ("displacement_sigma_metres", f"sigma_{axis}_mm"),
            ("raw_displacement_metres", f"raw_{axis}_mm"),
        ):
            assert value(found, name, axis=axis) == pytest.approx(last[key] / 1000, rel=1e-12)
    assert value(found, "last_slot_flag") == last["flag"]
    assert value(found, "last_slot_timestamp_seconds") == seconds(last["slot_utc"])
    good = seconds(status["last_good_slot_utc"])
    assert value(found, "last_good_slot_timestamp_seconds") == good
    for window in ("24h", "30d"):
        coverage = status[f"coverage_{window}"]
        for outcome in ("good", "suspect", "bad", "missing", "unaccounted"):
            counted = value(found, "slots", window=window, outcome=outcome)
            assert counted == coverage[outcome]
        for cause in GapCause:
            missed = value(found, "slots_missed", window=window, cause=cause.value)
            assert missed == coverage["gaps"].get(cause.value, 0)
        ratio = value(found, "coverage_ratio", window=window)
        assert ratio == pytest.approx(13 / coverage["expected"])
    assert value(found, "slots_missed", window="24h", cause="camera_lost") == 2
    calibration = status["calibration"]
    assert value(found, "calibration_id") == calibration["id"]
    created = value(found, "calibration_created_timestamp_seconds")
    assert created == seconds(calibration["created_utc"])
    assert value(found, "disk_size_bytes") == status["disk"]["total_bytes"]
    assert value(found, "daemon_up") == 1


def test_what_is_not_known_has_no_line_and_a_dead_daemon_is_down(site: Site) -> None:
    """A row in the dark: no displacement, no zero in its place; the last good row stays known."""
    site.measure(1, DARK)
    text = site.ctl("metrics", "--at", site.end.isoformat()).out
    assert "displacement" not in text
    found = read(text)
    assert value(found, "daemon_up") == 0
    assert value(found, "last_slot_flag") == 4
    assert "camera_temperature_celsius" not in names(found)
    behind = value(found, "last_slot_timestamp_seconds") - 60
    assert value(found, "last_good_slot_timestamp_seconds") == behind


def test_temperature_and_exposure_of_each_camera_are_reported(site: Site) -> None:
    site.measure(1, main_camera=CameraState(5000.0, 1.5, 41.5), sub_camera=CameraState(250.0))
    found = read(metrics(site).out)
    assert value(found, "camera_temperature_celsius", camera="main") == 41.5
    assert value(found, "camera_exposure_seconds", camera="sub") == pytest.approx(250e-6)
    assert ("dcam_camera_temperature_celsius", (("camera", "sub"),)) not in found


def test_a_file_is_replaced_whole_and_readable_by_others(site: Site, tmp_path: Path) -> None:
    file = tmp_path / "dcam.prom"
    file.write_text("half of an older fi")
    ran = metrics(site, "--output", file)
    assert (ran.code, ran.out, ran.err) == (0, "", "")
    assert value(read(file.read_text()), "level") == 0
    assert stat.S_IMODE(file.stat().st_mode) & stat.S_IROTH
    assert [path.name for path in tmp_path.glob("*prom*")] == ["dcam.prom"]


def test_a_site_that_cannot_be_looked_at_leaves_no_old_figures(site: Site, tmp_path: Path) -> None:
    file = tmp_path / "dcam.prom"
    metrics(site, "--output", file)
    (site.state / "dcam.db").write_bytes(b"no database" * 1000)
    ran = metrics(site, "--output", file)
    assert ran.code == 5
    assert len(ran.err.splitlines()) == 1
    found = read(file.read_text())
    assert names(found) == {"level", "status_level"}
    assert value(found, "status_level", item="status") == 2
    site.config.write_text("nonsense")
    assert site.ctl("metrics", "--output", file).code == 3
    assert value(read(file.read_text()), "level") == 3


def test_an_output_that_cannot_be_made_is_reported_by_its_directory(
    site: Site, tmp_path: Path
) -> None:
    ran = metrics(site, "--output", tmp_path / "nowhere" / "dcam.prom")
    assert ran.code == 4
    assert f"{tmp_path / 'nowhere'}: No such file or directory" in ran.err


def test_help_and_type_stand_before_each_metric(site: Site) -> None:
    lines = metrics(site).out.splitlines()
    assert lines
    for line in lines:
        if not line.startswith("#"):
            name = line.partition("{")[0].partition(" ")[0]
            assert f"# TYPE {name} gauge" in lines
            assert any(other.startswith(f"# HELP {name} ") for other in lines)


def test_metrics_load_no_numerics_and_no_orm(site: Site) -> None:
    """They are asked for every minute, as status is."""
    loaded = modules_of("--config", site.config, "--state", site.state, "metrics")
    assert loaded.isdisjoint({"scipy", "cv2", "numba", "sqlalchemy", "alembic"})


def test_a_file_that_node_exporter_would_not_read_is_refused(site: Site, tmp_path: Path) -> None:
    """Its textfile collector takes `*.prom` only: the figures would be missed in silence."""
    ran = site.ctl("metrics", "--output", tmp_path / "m.txt")
    assert (ran.code, ran.out) == (2, "")
    assert "must end in .prom" in ran.err
    assert not (tmp_path / "m.txt").exists()
