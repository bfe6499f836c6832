"""The chain by least squares: sums along it, surveys that later links follow, loops that help."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from core.results import Displacement
from daemon.datum.chain import NOTHING, Observation, origin, relinked, solve, weighted_mean
from daemon.datum.survey import surveyed
from daemon.store.records import DatumMethod, DatumRecord, DatumStep

NOW = datetime(2026, 6, 1, tzinfo=UTC)


def seen(x_mm: float, y_mm: float, sigma_mm: float = 0.1) -> Displacement:
    return Displacement(np.array([x_mm, y_mm]), sigma_mm**2 * np.eye(2))


def link(from_id: int | None, offset: Displacement, **targets: Displacement) -> DatumRecord:
    """One step from another calibration; its own offset is still to be solved."""
    step = DatumStep(DatumMethod.OLD_CALIBRATION, from_id, offset, targets)
    return DatumRecord(DatumMethod.OLD_CALIBRATION, NOTHING, (step,), NOW)


def chain_of(*steps: Displacement) -> dict[int, DatumRecord]:
    """Calibration 1 is the zero, each next one is seen from the one before."""
    links = {2 + at: link(1 + at, step) for at, step in enumerate(steps)}
    return {1: origin(NOW, None), **relinked({1: origin(NOW, None)}, links, NOW)}


def test_offsets_add_up_and_so_do_their_variances() -> None:
    links = chain_of(seen(1.0, 2.0, 0.3), seen(0.5, -1.0, 0.4))
    assert links[3].offset.mm == pytest.approx([1.5, 1.0])
    assert np.sqrt(np.diag(links[3].offset.covariance_mm2)) == pytest.approx([0.5, 0.5])
    assert links[1].offset.mm.tolist() == [0.0, 0.0]


def test_later_links_follow_a_survey_of_an_earlier_one() -> None:
    links = chain_of(seen(1.0, 2.0), seen(0.5, -1.0))
    given = surveyed(links[2], 10.0, 20.0, 0.2, "levelling", NOW)
    changed = relinked(links, {2: given}, NOW)
    assert sorted(changed) == [2, 3]
    assert changed[2].offset.mm == pytest.approx([10.0, 20.0])
    assert changed[3].offset.mm == pytest.approx([10.5, 19.0])
    assert np.sqrt(changed[3].offset.covariance_mm2[0, 0]) == pytest.approx(np.hypot(0.2, 0.1))


def test_a_survey_of_y_leaves_x_as_it_was_known() -> None:
    links = chain_of(seen(1.0, 2.0))
    changed = relinked(links, {2: surveyed(links[2], None, 12.3, 0.5, "levelling", NOW)}, NOW)
    assert changed[2].offset.mm == pytest.approx([1.0, 12.3], abs=1e-6)
    sigmas = np.sqrt(np.diag(changed[2].offset.covariance_mm2))
    assert sigmas == pytest.approx([0.1, 0.5], rel=1e-4)
    assert changed[2].method is DatumMethod.SURVEY


def test_a_survey_of_the_first_calibration_moves_the_whole_record() -> None:
    links = chain_of(seen(1.0, 2.0))
    changed = relinked(links, {1: surveyed(links[1], None, 100.0, 0.5, "gauge", NOW)}, NOW)
    assert changed[1].offset.mm == pytest.approx([0.0, 100.0], abs=1e-6)
    assert changed[2].offset.mm == pytest.approx([1.0, 102.0], abs=1e-6)
    sigmas = np.sqrt(np.diag(changed[2].offset.covariance_mm2))
    assert sigmas == pytest.approx([0.1, np.hypot(0.5, 0.1)], rel=1e-4)


def test_a_survey_at_the_end_of_a_chain_leaves_the_others_alone() -> None:
    links = chain_of(seen(1.0, 2.0), seen(0.5, -1.0))
    assert sorted(relinked(links, {3: surveyed(links[3], 7.0, 8.0, 0.2, "x", NOW)}, NOW)) == [3]


def test_two_observations_of_one_step_meet_by_their_weights() -> None:
    found = solve([Observation(2, 1, seen(0.0, 0.0, 0.1)), Observation(2, 1, seen(1.0, 1.0, 0.2))])
    assert found[2].mm == pytest.approx([0.2, 0.2], abs=1e-6)
    assert found[2].covariance_mm2[0, 0] == pytest.approx(1.0 / (100 + 25), rel=1e-6)


def test_further_targets_have_offsets_of_their_own_and_survive_a_survey() -> None:
    zero = {1: origin(NOW, None)}
    first = relinked(zero, {2: link(1, seen(1.0, 2.0), quarter=seen(0.3, 0.4))}, NOW)
    chain = {**zero, **first}
    chain |= relinked(chain, {3: link(2, seen(1.0, 1.0), quarter=seen(0.1, 0.1))}, NOW)
    assert chain[3].targets["quarter"].mm == pytest.approx([0.4, 0.5])
    changed = relinked(chain, {2: surveyed(chain[2], 9.0, 9.0, 0.1, "x", NOW)}, NOW)
    assert changed[3].offset.mm == pytest.approx([10.0, 10.0])
    assert changed[3].targets["quarter"].mm == pytest.approx([0.4, 0.5])


def test_a_mean_does_not_average_what_all_looks_share() -> None:
    shared_mm2 = 0.09 * np.eye(2)
    rng = np.random.default_rng(1)
    looks = [
        Displacement(rng.normal(1.0, 0.1, 2), 0.01 * np.eye(2) + shared_mm2, shared_mm2)
        for _ in range(100)
    ]
    mean = weighted_mean(looks)
    assert mean.mm == pytest.approx([1.0, 1.0], abs=0.04)
    assert np.sqrt(mean.covariance_mm2[0, 0]) == pytest.approx(np.hypot(0.3, 0.01), rel=0.01)


def test_a_mean_of_looks_that_scatter_more_than_they_say_is_as_wide() -> None:
    rng = np.random.default_rng(2)
    looks = [Displacement(rng.normal(0.0, 1.0, 2), 0.01 * np.eye(2)) for _ in range(400)]
    assert np.sqrt(weighted_mean(looks).covariance_mm2[1, 1]) == pytest.approx(0.05, rel=0.15)
