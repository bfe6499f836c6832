"""What is kept of a study, and what a run says of figures that are other than before."""

from pathlib import Path

from studies.keep import Keep
from studies.page import Claim, Report, Table


def test_a_block_is_computed_once_and_again_for_other_parameters(tmp_path: Path) -> None:
    computed = []

    def compute() -> list[float]:
        computed.append(1)
        return [0.1]

    for seed in (1, 1, 2):
        keep = Keep(tmp_path, ("studies/page.py",))  # as another run would
        assert keep.block("one", {"seed": seed}, compute) == [0.1]
    assert len(computed) == 2


def test_a_figure_that_differs_by_more_than_rounding_is_named(tmp_path: Path) -> None:
    def written(most: str, seconds: str) -> list[str]:
        table = Table(("block", "max / rms", "time s"), (("6-DOF", most, seconds),))
        claims = [Claim("it is so", holds=True)]
        return Report("made", "Made", "{table t}", {"t": table}, claims).write(tmp_path)

    assert written("0.100 / 0.050", "1") == []
    assert written("0.101 / 0.050", "7") == []
    assert written("0.101 / 0.060", "7") == [
        "made-t.csv: 6-DOF, max / rms: 0.101 / 0.050 before, 0.101 / 0.060 now"
    ]
