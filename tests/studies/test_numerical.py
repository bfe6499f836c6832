"""The numerical study, a few frames of one resolution: its columns, and what it must show."""

from pathlib import Path

import pytest

from studies.keep import Keep
from studies.numerical import CODE, run
from studies.numerical_points import BLOCKS, ways
from studies.page import Report


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    keep = Keep(tmp_path_factory.mktemp("kept"), CODE)
    sub_pixel = next(way for way in ways() if way.name == "1920 x 1200, sub-pixel")
    return run(keep, frames=12, points=(sub_pixel,), by_pan_tilt=(True,))


def test_only_the_rigid_model_holds_after_pan_tilt_motions(report: Report) -> None:
    assert [claim.holds for claim in report.claims] == [True, True]
    of_paper, of_rigid = (report.tables[f"{m}-b"].rows[0][-1] for m in ("paper", "rigid"))
    assert float(of_paper.split()[0]) > 1.0
    assert float(of_rigid.split()[0]) < 0.1


def test_tables_have_a_column_for_each_block(report: Report, tmp_path: Path) -> None:
    assert report.write(tmp_path) == []
    page = (tmp_path / "numerical.md").read_text(encoding="utf-8")
    assert f"| points | {' | '.join(BLOCKS)} |" in page
    assert "{table" not in page
    assert (tmp_path / "numerical.png").stat().st_size > 10_000
