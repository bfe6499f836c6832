"""A rig that was watched for a month is predicted when its fixed target is hidden."""

from __future__ import annotations

import numpy as np

from core.moment import Moment
from core.rig.learnt import learn
from tests.core.rig.test_learning import C_URAD_PER_K, hours

WATCHED_DAYS, HIDDEN_DAYS = 30, 15


def test_a_hidden_targets_turn_is_predicted_with_its_sigma() -> None:
    """Half the error of a rig that learnt nothing, at most, and the sigma is true."""
    within, with_learnt, without = [], [], []
    for seed in range(16):
        record = hours(seed, WATCHED_DAYS + HIDDEN_DAYS)
        seconds = 1.8e9 + 86_400.0 * record.days
        urad = 1e6 * record.mm[:, 0] / record.distance_mm[0]
        seen = record.days < WATCHED_DAYS
        learnt = learn(seconds[seen], record.warmth_k[seen], urad[seen])
        assert learnt is not None
        assert np.all(np.abs(learnt.mean[:, 1] / C_URAD_PER_K - 1.0) < 0.2)
        for now in np.flatnonzero(~seen)[5::60]:
            predicted = learnt.turn(Moment(seconds[now], record.warmth_k[now]))
            assert predicted is not None
            missed = urad[now] - predicted[0]
            within.append(np.abs(missed) < np.sqrt(predicted[1]))
            with_learnt.append(missed)
            without.append(urad[now] - urad[0])
    assert np.sqrt(np.square(with_learnt).mean()) < 0.5 * np.sqrt(np.square(without).mean())
    assert 0.55 < np.mean(within) < 0.85


def test_too_little_teaches_nothing() -> None:
    record = hours(0, 20)
    seconds, urad = 86_400.0 * record.days, 1e6 * record.mm[:, 0] / record.distance_mm[0]
    week = record.days < 6.5
    assert learn(seconds, record.warmth_k, urad) is not None
    assert learn(seconds[week], record.warmth_k[week], urad[week]) is None
    assert learn(seconds, np.full(len(urad), 12.0), urad) is None
    last = learn(seconds, record.warmth_k, urad)
    assert last is not None
    assert last.turn(Moment(seconds[-1] + 60.0, None)) is None
