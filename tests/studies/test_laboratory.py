"""The laboratory study at half the pixels and few positions: its columns, and who errs least."""

from pathlib import Path

from studies.keep import Keep
from studies.laboratory import CODE, run
from studies.peers import run as run_peers
from studies.peers_frames import has_programs


def test_our_corners_and_model_err_least(tmp_path: Path) -> None:
    keep = Keep(tmp_path / "laboratory", CODE)
    few = {"positions": 5, "lens_views": 4, "shrink": 3.0}
    report = run(keep, **few, limit_mm=0.3)
    assert [claim.holds for claim in report.claims] == [True]
    table = report.tables["errors"]
    assert table.columns[2] == "error, largest mm"
    largest_mm = {row[0]: float(row[2]) for row in table.rows}
    assert largest_mm["dcam, rigid"] == min(largest_mm.values())
    assert report.write(tmp_path / "docs") == []
    peers = run_peers(Keep(tmp_path / "peers", CODE), **few)  # the same frames, not rendered again
    assert peers.tables["peers"].columns[-1].endswith(" s")
    others = {row[0]: row[2] for row in peers.tables["peers"].rows}
    assert set(others) == {"dcam", "OpenCV", "mrgingham, ViSP", "mrgingham, ViSP; mrcal"}
    assert (others["mrgingham, ViSP; mrcal"] != "not run") == has_programs()
    assert [claim.holds for claim in peers.claims] == [True]
