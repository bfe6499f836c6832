"""What was put into a series comes back, within the interval that is stated, at the stated rate."""

from __future__ import annotations

import tracemalloc
from datetime import UTC, datetime

import numpy as np
import pytest

from benchmarks.bridges import BEGIN_S, DAY_S, Bridge, make, remembering
from core.analysis.binning import bins_of, hours_of
from core.analysis.noise import Whitening, fit_noise, gls
from core.analysis.readings import Lag
from core.analysis.regression import by_blocks, daily, step_information, yearly
from core.analysis.steps import find_steps, recent_drift
from core.analysis.thermal import temperature_response
from core.analysis.trend import difference, trend_of
from tests.exhaustive import one_of

SERIES = 20 // one_of(2)
MISSES = 2 if SERIES == 10 else 3
"""More of them a 95 % interval misses once in 60 runs of other numbers; of ten, once in 87."""


def hours_with_gaps(rng: np.random.Generator, days: float) -> np.ndarray:
    """Times of hours of which a tenth is missing, one week among them."""
    times_s = BEGIN_S + 3600.0 * np.arange(int(days * 24))
    keep = rng.random(len(times_s)) > 0.05
    keep[len(keep) // 3 : len(keep) // 3 + 168] = False
    return times_s[keep]


def noise_at(rng: np.random.Generator, times_s: np.ndarray) -> np.ndarray:
    """Hourly noise that remembers hours and days."""
    n = int((times_s[-1] - times_s[0]) / 3600.0) + 1
    whole = remembering(rng, n, 0.03, 3.0) + remembering(rng, n, 0.02, 120.0)
    whole += 0.01 * rng.normal(size=n)
    return whole[((times_s - times_s[0]) / 3600.0).astype(int)]


def test_days_have_the_lowest_mean_and_highest_of_their_own_rows() -> None:
    found = bins_of(
        np.array([0.0, 1.0, 2.0, 3.0, 9.0]),
        np.array([1.0, 5.0, np.nan, -2.0, 7.0]),
        np.array([0.0, 2.0, 4.0, 6.0]),
    )
    assert found.lowest.tolist()[:2] == [1.0, -2.0]
    assert found.mean.tolist()[:2] == [3.0, -2.0]
    assert found.highest.tolist()[:2] == [5.0, -2.0]
    assert found.count.tolist() == [2, 1, 0]
    assert np.isnan(found.mean[2])


def test_a_value_that_never_moves_has_no_trend_and_no_step() -> None:
    """A further target's axis that is not measured, or a record of a stuck number."""
    times_s = hours_with_gaps(np.random.default_rng(0), 120.0)
    values_mm = np.full(len(times_s), 0.5)
    trend = trend_of(times_s, values_mm, with_days=False)
    assert abs(trend.mm_per_year.value) < 1e-9
    assert find_steps(times_s, values_mm).steps == ()
    assert not recent_drift(times_s, values_mm).significant
    assert abs(difference(times_s, values_mm, BEGIN_S + 60.0 * DAY_S).mm.value) < 1e-9


def test_one_wild_row_does_not_move_its_hour_and_a_short_hour_is_none() -> None:
    times_s = np.arange(0.0, 3 * 3600.0, 60.0)
    values_mm = 0.1 * np.sin(times_s)
    values_mm[70] = 50.0
    keep = (times_s < 2 * 3600.0) | (times_s > 3 * 3600.0 - 600.0)
    hours = hours_of(times_s[keep], values_mm[keep], np.empty((int(keep.sum()), 0)))
    assert hours.count.tolist() == [60, 59]
    assert np.abs(hours.mean_mm).max() < 0.02


@pytest.mark.parametrize("weighted", [False, True])
def test_the_fast_inverse_is_that_of_the_covariance(*, weighted: bool) -> None:
    """Also of means of many and of few, whose white parts differ."""
    rng = np.random.default_rng(1)
    weights = rng.uniform(0.2, 5.0, 60) if weighted else np.ones(60)
    days = np.sort(rng.uniform(0.0, 30.0, 60))
    gains, memories = np.array([1.5, 0.7]), np.array([0.2, 10.0])
    apart = np.abs(days[:, None] - days)
    parts = sum(g**2 * np.exp(-apart / m) for g, m in zip(gains, memories, strict=True))
    K = np.diag(1.0 / weights) + parts
    whitening = Whitening(days, gains, memories, weights if weighted else None)
    inverse = np.linalg.inv(K)
    assert whitening.solve(np.eye(60)) == pytest.approx(inverse, abs=1e-9)
    columns = rng.normal(size=(60, 3))
    assert whitening.squares(columns) == pytest.approx(np.diag(columns.T @ inverse @ columns))
    assert whitening.log_determinant == pytest.approx(np.linalg.slogdet(K)[1])


def test_what_a_step_could_be_found_with_takes_little_memory_of_a_year_of_hours() -> None:
    """Of the columns of hundreds of places together it would be 250 MB."""
    rng = np.random.default_rng(4)
    days = hours_with_gaps(rng, 365.0) / DAY_S
    values_mm = rng.normal(size=len(days))
    white = Whitening(days, np.array([2.0, 5.0]), np.array([0.3, 20.0]))
    fit = gls(white, np.ones((len(days), 1)), values_mm)
    tracemalloc.start()
    try:
        information = step_information(white, fit)
        taken_mb = tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
    assert taken_mb < 30.0
    at = len(days) - 10  # one column by itself
    step = (np.arange(len(days)) >= at).astype(np.float64)
    beside = gls(white, np.column_stack([np.ones(len(days)), step]), values_mm)
    sigma_mm = np.sqrt(beside.covariance[1, 1] * fit.variance_mm2 / beside.variance_mm2)
    assert 1.0 / np.sqrt(information[at]) == pytest.approx(sigma_mm, rel=1e-6)


def test_the_noise_of_means_of_few_and_of_many_is_recognised() -> None:
    """A mean of 24 has a fifth of the noise of a single value; the search knows it."""
    rng = np.random.default_rng(3)
    weights = np.where(np.arange(600) < 300, 1.0, 24.0)
    days = np.arange(600) / 6.0
    values_mm = 0.1 * rng.normal(size=600) / np.sqrt(weights)
    values_mm += remembering(rng, 600, 0.05, 60.0)
    fit = fit_noise(days, np.ones((600, 1)), values_mm, weights=weights)
    assert fit.noise.white_mm == pytest.approx(0.1, rel=0.1)
    assert fit.noise.parts[1].sigma_mm == pytest.approx(0.05, rel=0.5)


def test_noise_of_hours_and_days_is_recognised() -> None:
    rng = np.random.default_rng(2)
    times_s = hours_with_gaps(rng, 250.0)
    fit = fit_noise(times_s / DAY_S, np.ones((len(times_s), 1)), noise_at(rng, times_s))
    fast, slow = fit.noise.parts
    assert fast.sigma_mm == pytest.approx(0.03, rel=0.2)
    assert fast.memory_days == pytest.approx(3.0 / 24.0, rel=0.4)
    assert slow.sigma_mm == pytest.approx(0.02, rel=0.4)
    assert 2.0 < slow.memory_days < 15.0


@pytest.mark.parametrize(
    ("lag_h", "first_order"), [(-1.5, False), (3.25, False), (2.0, True), (6.0, True)]
)
def test_a_temperature_comes_back_with_its_lag(lag_h: float, *, first_order: bool) -> None:
    """The sun's lead too: a displacement that is there before the sensor is warm."""
    bridge = Bridge(days=45.0, lag_h=lag_h, first_order=first_order)
    made = make(bridge, seed=7)
    hours = hours_of(made.times_s, made.y_mm, made.deck_c[:, None])
    found = temperature_response(hours, (0,))
    assert found is not None
    (response,) = found.responses
    assert response.kind is (Lag.FIRST_ORDER if first_order else Lag.SHIFT)
    assert response.lag_h.value == pytest.approx(lag_h, abs=3.0 * response.lag_h.sigma)
    assert response.lag_h.sigma < 0.2
    size = response.mm_per_unit
    assert size.value == pytest.approx(0.25, abs=4.0 * size.sigma)
    assert size.sigma < 0.005
    assert found.explained > 0.98


def test_slots_half_an_hour_apart_show_the_temperature_too() -> None:
    """Two of three spans of ten minutes then have no reading, and yet none is missing."""
    made = make(Bridge(days=45.0, lag_h=3.25), seed=7)
    taken = np.round(made.times_s / 60.0).astype(int) % 30 == 0
    hours = hours_of(made.times_s[taken], made.y_mm[taken], made.deck_c[taken, None])
    found = temperature_response(hours, (0,))
    assert found is not None
    (response,) = found.responses
    assert response.lag_h.value == pytest.approx(3.25, abs=3.0 * response.lag_h.sigma)
    assert response.lag_h.sigma < 0.05
    assert response.mm_per_unit.value == pytest.approx(0.25, abs=0.005)


def test_a_deck_and_a_slow_girder_come_back_as_two_masses() -> None:
    """As one mass a tenth of a millimetre and more is left, and a part of the size is missed."""
    bridge = Bridge(days=45.0, lag_h=1.5, first_order=True, slow_share=0.4, slow_h=18.0)
    made = make(bridge, seed=12)
    found = temperature_response(hours_of(made.times_s, made.y_mm, made.deck_c[:, None]), (0,))
    assert found is not None
    quick, slow = found.responses
    assert (quick.slow, slow.slow) == (False, True)
    for response, lag_h, size in ((quick, 1.5, 0.15), (slow, 18.0, 0.1)):
        assert response.lag_h.value == pytest.approx(lag_h, abs=3.0 * response.lag_h.sigma)
        assert response.lag_h.sigma < 0.15 * lag_h
        assert response.mm_per_unit.value == pytest.approx(
            size, abs=3.0 * response.mm_per_unit.sigma
        )
    assert found.left_mm < 0.03


def test_weather_that_no_sensor_shows_widens_the_interval_of_a_lag() -> None:
    """Stretches of other weather differ by more than the noise within them lets expect."""
    widths = []
    for unseen_mm in (0.0, 0.1):
        made = make(Bridge(days=45.0, unseen_mm=unseen_mm), seed=13)
        found = temperature_response(hours_of(made.times_s, made.y_mm, made.deck_c[:, None]), (0,))
        assert found is not None
        widths.append(found.responses[0].mm_per_unit.sigma)
    assert widths[1] > 5.0 * widths[0]


def test_what_stretches_differ_by_is_the_error_whatever_the_noise() -> None:
    """A mean of noise that remembers half a day, fitted as if hours were independent."""
    within = 0
    days = np.arange(0.0, 100.0, 1.0 / 24.0)
    design = np.ones((len(days), 1))
    for seed in range(SERIES):
        values_mm = remembering(np.random.default_rng(seed), len(days), 1.0, 12.0)
        white = gls(Whitening(days, np.array([1e-3]), np.array([1.0])), design, values_mm)
        found = by_blocks(days, design, white, np.ones(1), 0.95)
        assert found is not None
        assert found.sigma > 3.0 * np.sqrt(white.covariance[0, 0])
        within += found.low <= 0.0 <= found.high
    assert within >= SERIES - MISSES
    few = days < 10.0
    short = gls(Whitening(days[few], np.ones(1), np.ones(1)), design[few], days[few])
    assert by_blocks(days[few], design[few], short, np.ones(1), 0.95) is None


def test_two_readings_are_told_apart() -> None:
    made, other = make(Bridge(days=45.0), seed=8), make(Bridge(days=45.0, outages=0.0, lost=0.0), 9)
    bearing_c = np.interp(made.times_s, other.times_s, other.deck_c)
    y_mm = made.y_mm - 0.1 * np.interp(made.times_s - 3600.0, made.times_s, bearing_c)
    readings = np.column_stack([made.deck_c, bearing_c])
    found = temperature_response(hours_of(made.times_s, y_mm, readings), (0, 1))
    assert found is not None
    deck, bearing = found.responses
    assert deck.mm_per_unit.value == pytest.approx(0.25, abs=0.005)
    assert bearing.mm_per_unit.value == pytest.approx(-0.1, abs=0.005)
    assert (deck.lag_h.value, bearing.lag_h.value) == pytest.approx((2.0, 1.0), abs=0.1)


def test_a_trend_of_two_years_lies_in_its_interval() -> None:
    """Daily means with season, gaps and bad values; a trend of white noise would miss most."""
    inside = 0
    for seed in range(SERIES):
        rng = np.random.default_rng(seed)
        times_s = BEGIN_S + DAY_S * np.flatnonzero(rng.random(730) > 0.1)
        days = ((times_s - BEGIN_S) / DAY_S).astype(int)
        truth = float(rng.normal())
        values_mm = remembering(rng, 730, 0.2, 8.0)[days] + 0.1 * rng.normal(size=len(days))
        values_mm += truth * days / 365.25 + 3.0 * np.cos(2.0 * np.pi * days / 365.25 + 1.0)
        values_mm[rng.integers(0, len(days), 5)] += 4.0
        found = trend_of(times_s, values_mm, with_days=False)
        assert found.seasonal
        assert found.mm_per_year.sigma < 0.25
        inside += found.mm_per_year.low <= truth <= found.mm_per_year.high
    assert inside >= SERIES - MISSES


def test_a_step_is_found_a_day_after_it_with_its_size_and_time() -> None:
    """0.1 mm on a daily cycle of several mm, from minutes with gaps."""
    made = make(Bridge(days=45.0, step_day=44.0, step_mm=0.1), seed=11)
    hours = hours_of(made.times_s, made.y_mm, made.deck_c[:, None])
    warm = temperature_response(hours, (0,))
    assert warm is not None
    beside = np.column_stack([warm.columns, warm.by_lag])[warm.known]
    found = find_steps(hours.times_s[warm.known], hours.mean_mm[warm.known], beside)
    (step,) = found.steps
    assert step.first_s - 3600.0 <= BEGIN_S + 44.0 * DAY_S <= step.last_s + 3600.0
    assert step.mm.value == pytest.approx(0.1, abs=4.0 * step.mm.sigma)
    assert step.mm.sigma < 0.02
    assert found.smallest_in_a_day_mm < 0.1


def test_steps_and_bad_hours_are_told_apart_and_quiet_series_have_none() -> None:
    for seed in range(2):
        rng = np.random.default_rng(seed)
        times_s = hours_with_gaps(rng, 60.0)
        quiet_mm = noise_at(rng, times_s)
        bad_mm = quiet_mm.copy()
        bad_mm[[200, 700]] += 1.0
        assert find_steps(times_s, bad_mm).steps == ()
        event_s, second_s = BEGIN_S + 20.0 * DAY_S, BEGIN_S + 40.0 * DAY_S
        values_mm = bad_mm + 6.5 * (times_s >= event_s) - 0.3 * (times_s >= second_s)
        casting, back = find_steps(times_s, values_mm).steps
        assert casting.first_s <= event_s <= casting.last_s  # in the week without values
        assert abs(back.time_s - second_s) <= 7200.0
        assert casting.mm.value == pytest.approx(6.5, abs=4.0 * casting.mm.sigma)
        assert back.mm.value == pytest.approx(-0.3, abs=4.0 * back.mm.sigma)


def test_a_drift_of_three_months_is_one_and_a_quiet_record_has_none() -> None:
    for seed in range(2):
        rng = np.random.default_rng(seed)
        times_s = hours_with_gaps(rng, 180.0)
        values_mm = noise_at(rng, times_s)
        quiet = recent_drift(times_s, values_mm)
        assert not quiet.significant
        since_days = np.maximum((times_s - BEGIN_S) / DAY_S - 90.0, 0.0)
        drifting = recent_drift(times_s, values_mm + since_days / 365.25)
        assert drifting.significant
        assert drifting.mm_per_year.low <= 1.0 <= drifting.mm_per_year.high


def test_the_level_after_an_event_less_that_before_lies_in_its_interval() -> None:
    """A drift is a part of it: creep after the casting moves the level too."""
    inside = 0
    for seed in range(SERIES):
        rng = np.random.default_rng(seed)
        times_s = hours_with_gaps(rng, 20.0)
        event_s = BEGIN_S + 10.0 * DAY_S
        moved_mm = -6.5 * (times_s >= event_s) - 10.0 * (times_s - BEGIN_S) / DAY_S / 365.25
        values_mm = noise_at(rng, times_s) + moved_mm + 2.0 * daily(times_s)[:, 0]
        found = difference(times_s, values_mm, event_s)
        after = times_s >= event_s
        truth = float(moved_mm[after].mean() - moved_mm[~after].mean())
        assert found.mm.sigma < 0.1
        inside += found.mm.low <= truth <= found.mm.high
    assert inside >= SERIES - MISSES
    with pytest.raises(ValueError, match="before or after"):
        difference(times_s, values_mm, BEGIN_S)


def test_the_nile_fell_in_1899_by_what_the_literature_says() -> None:
    """Cobb, Biometrika 65 (1978): 1097.8 before, 849.9 after, of 100 years."""
    from statsmodels.datasets import nile

    data = nile.load_pandas().data
    times_s = np.array([datetime(int(year), 7, 1, tzinfo=UTC).timestamp() for year in data.year])
    found = find_steps(times_s, data.volume.to_numpy(), with_days=False, bend_days=np.inf)
    (step,) = found.steps
    assert datetime.fromtimestamp(step.time_s, UTC).year == 1899
    assert step.mm.value == pytest.approx(-247.8, abs=0.1)
    assert step.mm.low < -200.0 < step.mm.high + 10.0


def test_the_carbon_dioxide_of_mauna_loa_rises_beside_its_season_without_a_step() -> None:
    """Weeks with gaps: Keeling's curve, of which the last 15 years of the set are taken."""
    from statsmodels.datasets import co2

    series = co2.load_pandas().data.co2.dropna()
    times_s = series.index.to_numpy().astype("datetime64[s]").astype(np.float64)
    ppm = series.to_numpy()
    late = times_s > times_s[-1] - 15.0 * 365.25 * DAY_S
    times_s, ppm = times_s[late], ppm[late]
    trend = trend_of(times_s, ppm, with_days=False)
    years = 10.0  # of whole years the season has no part in the difference
    first = times_s < times_s[0] + 2.0 * 365.25 * DAY_S
    same = (times_s >= times_s[0] + years * 365.25 * DAY_S) & (
        times_s < times_s[0] + (years + 2.0) * 365.25 * DAY_S
    )
    plain = (ppm[same].mean() - ppm[first].mean()) / years
    assert trend.seasonal
    assert trend.mm_per_year.value == pytest.approx(plain, abs=0.1)
    assert 0.01 < trend.mm_per_year.sigma < 0.1
    found = find_steps(times_s, ppm, yearly(times_s), with_days=False, bend_days=365.0)
    assert found.steps == ()
