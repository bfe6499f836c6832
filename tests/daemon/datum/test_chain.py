"""The chain by least squares: sums along it, surveys that later links follow, loops that help."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from core.results import Displacement
from core.rig.reference_errors import Gains, ReferenceErrors
from core.site import MAIN
from daemon.datum.chain import (
    NOTHING,
    Observation,
    offset_by,
    origin,
    relinked,
    solve,
    weighted_mean,
)
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
    assert found[2].offset.mm == pytest.approx([0.2, 0.2], abs=1e-6)
    assert found[2].offset.covariance_mm2[0, 0] == pytest.approx(1.0 / (100 + 25), rel=1e-6)


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


NOISE_MM2 = np.array([[0.004, 0.001], [0.001, 0.006]])
OF_MAIN = ReferenceErrors((MAIN,), (False,), np.kron(np.diag([1.0, 0.0]), NOISE_MM2))
ALONE: dict[str, Gains] = {MAIN: {}}


def measured_link(from_id: int, method: DatumMethod = DatumMethod.OLD_CALIBRATION) -> DatumRecord:
    """A step whose sigma is the noise of both references, and a little more."""
    offset = Displacement(np.array([1.0, 0.5]), 2.0 * NOISE_MM2 + 1e-4 * np.eye(2))
    step = DatumStep(method, from_id, offset, {}, ALONE, ALONE)
    if method is DatumMethod.SAME_REFERENCE:
        step = DatumStep(method, from_id, NOTHING)
    return DatumRecord(method, NOTHING, (step,), NOW, errors=OF_MAIN)


def test_the_noise_of_a_reference_in_the_middle_of_a_chain_cancels() -> None:
    """It is in the link that measured it, and in the next one with the opposite sign."""
    zero = {1: origin(NOW, None, OF_MAIN)}
    chain = relinked(zero, {number: measured_link(number - 1) for number in (2, 3, 4)}, NOW)
    expected = 2.0 * NOISE_MM2 + 3e-4 * np.eye(2)
    assert chain[4].offset.covariance_mm2 == pytest.approx(expected, rel=1e-4)
    assert chain[4].shared[MAIN][:2] == pytest.approx(NOISE_MM2, rel=1e-4)


def test_a_chain_adjusted_as_a_whole_is_the_chain_link_by_link() -> None:
    zero = {1: origin(NOW, None, OF_MAIN)}
    methods = (DatumMethod.OLD_CALIBRATION, DatumMethod.SAME_REFERENCE, DatumMethod.ROWS)
    links = {2 + at: measured_link(1 + at, method) for at, method in enumerate(methods)}
    whole = zero | relinked(zero, links, NOW)
    base = zero[1]
    for number, one in links.items():
        solved = offset_by(one.steps[0], base, one.errors)
        assert solved.shared is not None
        assert solved.offset.mm == pytest.approx(whole[number].offset.mm, abs=1e-5)
        mm2 = whole[number].offset.covariance_mm2
        assert solved.offset.covariance_mm2 == pytest.approx(mm2, rel=1e-4)
        assert solved.shared == pytest.approx(whole[number].shared[MAIN], rel=1e-4, abs=1e-9)
        base = replace(one, offset=solved.offset, shared={MAIN: solved.shared})


def test_two_looks_at_one_reference_do_not_average_its_noise() -> None:
    zero = {1: origin(NOW, None, OF_MAIN)}
    twice = measured_link(1)
    twice = replace(twice, steps=twice.steps * 2)
    mm2 = relinked(zero, {2: twice}, NOW)[2].offset.covariance_mm2
    assert mm2 == pytest.approx(2.0 * NOISE_MM2 + 0.5e-4 * np.eye(2), rel=1e-4)


def test_a_survey_has_nothing_in_common_with_the_reference() -> None:
    zero = {1: origin(NOW, None, OF_MAIN)}
    chain = zero | relinked(zero, {2: measured_link(1)}, NOW)
    changed = relinked(chain, {2: surveyed(chain[2], 5.0, 6.0, 0.2, "levelling", NOW)}, NOW)
    assert changed[2].shared[MAIN] == pytest.approx(np.zeros((4, 2)), abs=1e-9)
    assert changed[2].offset.covariance_mm2 == pytest.approx(0.04 * np.eye(2), rel=1e-4)
