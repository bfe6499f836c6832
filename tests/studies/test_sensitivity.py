"""The sensitivity study, its first cells: sigma grows with the distance; a fixed plate holds it."""

from pathlib import Path

from studies.keep import Keep
from studies.sensitivity import CODE, run


def test_sigma_grows_with_distance_and_a_plate_takes_temperature_off(tmp_path: Path) -> None:
    report = run(Keep(tmp_path / "sensitivity", CODE), only=3)
    cells = report.tables["cells"]
    assert cells.columns == ("what", "value", "sigma at rest, mm", "sigma within the drift, mm")
    sigmas = [float(row[3]) for row in cells.rows]
    assert sigmas == sorted(sigmas)
    assert sigmas[2] > 2.0 * sigmas[0]
    *_, (_, without, with_plate) = report.tables["season"].rows
    assert float(without) > 10.0 * float(with_plate)
