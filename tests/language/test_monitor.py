"""The over-optimisation monitor: it recovers Gao's curve, and alarms come only when they should."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.stats import linregress

from tightrope.language.alignment.monitor import FEWEST_POINTS, TREND_WINDOWS, Monitor, fit, trend_p_value

ALPHA, BETA, OFFSET = 1.0, 0.4, -0.3
PEAK_KL = math.exp(ALPHA / BETA - 1) ** 2  # 20.1 nats


def curve(kl, alpha=ALPHA, beta=BETA, offset=OFFSET):
    """Gao, Schulman & Hilton 2022, with an offset; independent of the code under test."""
    d = np.sqrt(kl)
    return offset + d * alpha - np.where(d > 0, beta * d * np.log(np.maximum(d, 1e-300)), 0.0)


def noisy_run(rng, kls, noise, **parameters):
    """(KL, gold) as a run measures them."""
    return [(kl, curve(kl, **parameters) + noise * rng.standard_normal()) for kl in kls]


# ------------------------------------------------------------------------------------- the fit


@given(alpha=st.floats(0.1, 3), beta=st.floats(0.2, 2), offset=st.floats(-5, 5), top=st.floats(2, 100))
def test_exact_points_give_their_curve_back(alpha, beta, offset, top):
    assume(alpha / beta < 6)
    points = [(kl, curve(kl, alpha, beta, offset)) for kl in np.linspace(0, top, 9)]
    found = fit(points)
    assert found.reason == ""
    assert (found.alpha, found.beta) == (pytest.approx(alpha, abs=1e-6), pytest.approx(beta, abs=1e-6))
    assert found.offset == pytest.approx(offset, abs=1e-6)
    assert found.r2 == pytest.approx(1, abs=1e-6)
    for kl, gold in points:
        assert found.gold(kl) == pytest.approx(gold, abs=1e-6)
    assert found.peak_kl == pytest.approx(found.peak_d**2)
    at_peak = found.gold(found.peak_kl)
    assert all(found.gold(found.peak_kl * factor) < at_peak for factor in (0.5, 0.9, 1.1, 2.0))


def test_the_peak_is_where_the_curve_is_highest():
    """By search, without the formula."""
    kls = np.linspace(0.01, 60, 200_000)
    found = fit([(kl, curve(kl)) for kl in (0, 2, 5, 9, 14)])
    assert found.peak_kl == pytest.approx(kls[curve(kls).argmax()], rel=1e-3)
    assert found.decided and found.peak_kl_low == pytest.approx(found.peak_kl_high, rel=1e-3)


def test_the_interval_covers_the_peak_as_often_as_it_says():
    """80 %, within the precision of 300 runs."""
    rng, covered, errors, explained = np.random.default_rng(1), 0, [], []
    for _ in range(300):
        found = fit(noisy_run(rng, np.linspace(0.2, 30, 20), noise=0.03))
        covered += found.peak_kl_low <= PEAK_KL <= found.peak_kl_high
        errors.append(abs(found.peak_kl - PEAK_KL) / PEAK_KL)
        explained.append(found.r2)
    assert np.median(explained) > 0.9
    assert 0.74 <= covered / 300 <= 0.86
    assert np.median(errors) < 0.1


def test_a_slow_start_does_not_hide_the_top():
    """PPO's gold score stays flat at first, where the law rises steepest; the far points must decide."""
    law = noisy_run(np.random.default_rng(2), np.linspace(0.2, 20, 25), noise=0.01)
    delayed = [(kl, gold * min(1.0, math.sqrt(kl) / 3)) for kl, gold in law]
    assert fit(delayed).peak_kl == pytest.approx(PEAK_KL, rel=0.3)


@given(st.lists(st.tuples(st.floats(-1, 50), st.floats(-3, 3)), max_size=12), st.randoms())
def test_the_order_of_the_points_does_not_matter_and_no_points_are_too_odd(points, random):
    found = fit(points)
    mixed = list(points)
    random.shuffle(mixed)
    again = fit(mixed)
    assert (found.reason == "") == (again.reason == "")
    if found.reason:
        assert math.isnan(found.alpha) and not found.decided
        return
    assert math.isfinite(found.alpha) and math.isfinite(found.beta)
    assert found.peak_kl >= 0 and found.peak_kl_low <= found.peak_kl_high
    scale = 1 + max(abs(gold) for _, gold in points)
    for kl in (0.0, 1.0, 10.0):
        spread = abs(found.alpha) + abs(found.beta) + scale
        assert again.gold(kl) == pytest.approx(found.gold(kl), abs=1e-4 * spread)


def test_points_that_are_too_much_alike_once_squared_are_named_and_raise_nothing():
    """Least squares accepts them; the matrix of the draws, which squares its condition, does not."""
    places = np.array([0.0, 14.0, 0.00048828125, 0.0007324218750000016, 0.00022870302200317423])
    for last in np.linspace(0.9, 1.1, 41):
        found = fit([(kl, 0.0) for kl in (*places[:4], places[4] * last)])
        assert not found.reason or "alike" in found.reason


@pytest.mark.parametrize("count", range(FEWEST_POINTS))
def test_too_few_points_are_reported(count):
    found = fit([(float(kl), curve(kl)) for kl in range(count)])
    assert found.reason == f"{count} points at different KLs, at least {FEWEST_POINTS} are needed"
    assert math.isnan(found.peak_kl) and math.isnan(found.gold(1.0)) and not found.decided


def test_many_points_at_one_kl_are_few_points():
    assert "1 points" in fit([(3.0, 0.1 * i) for i in range(20)]).reason


def test_kls_that_hardly_differ_are_reported_as_too_close():
    found = fit([(kl, curve(kl)) for kl in np.linspace(10, 20, 12)])
    assert found.reason == "the KLs reach from 10 to 20, too close to each other"


def test_points_that_are_not_finite_are_left_out_and_a_negative_kl_counts_as_zero():
    points = [(kl, curve(kl)) for kl in (0.0, 1.0, 3.0, 7.0, 12.0, 18.0)]
    odd = [(-0.02, OFFSET), (math.nan, 5.0), (4.0, math.nan), (math.inf, 1.0), *points[1:]]
    assert fit(odd) == fit(points)


def test_a_straight_line_in_d_has_no_peak():
    found = fit([(kl, 2 * math.sqrt(kl)) for kl in (0, 1, 3, 6, 10, 15)])
    assert found.beta == pytest.approx(0, abs=1e-9)
    assert not found.decided


def test_a_curve_that_bends_upwards_has_none_either():
    found = fit([(kl, curve(kl, 0.5, -0.4)) for kl in (0, 1, 3, 6, 10, 15)])
    assert (found.peak_d, found.peak_kl, found.decided) == (math.inf, math.inf, False)


def test_a_constant_gold_score_decides_nothing():
    found = fit([(kl, 1.5) for kl in (0, 1, 3, 6, 10, 15)])
    assert math.isnan(found.r2) and found.gold(8.0) == pytest.approx(1.5) and not found.decided


def test_noise_decides_nothing():
    """Gold scores unrelated to KL: a peak is predicted for few of 200 such runs."""
    rng = np.random.default_rng(2)
    decided = [
        fit([(kl, rng.standard_normal()) for kl in np.linspace(0.1, 10, 10)]).decided for _ in range(200)
    ]
    assert np.mean(decided) < 0.35


# ------------------------------------------------------------------------------------- alarms


def followed(monitor, points, proxy=None):
    """The kinds of alarm of a run, each with the KL at which it came."""
    alarms = []
    for index, (kl, gold) in enumerate(points):
        score = float(index) if proxy is None else proxy[index]
        alarms += [(alarm.kind, kl) for alarm in monitor.add(kl, score, gold)]
    return alarms


def test_the_alarm_comes_before_the_peak():
    rng, early = np.random.default_rng(3), 0
    for _ in range(40):
        kinds = dict(followed(Monitor(), noisy_run(rng, np.linspace(0, 40, 41), noise=0.02)))
        assert "peak near" in kinds or "peak passed" in kinds
        early += kinds.get("peak near", math.inf) < PEAK_KL
    assert early >= 36


def test_the_alarm_after_the_peak_comes_too():
    rng = np.random.default_rng(4)
    passed = [
        dict(followed(Monitor(), noisy_run(rng, np.linspace(0, 60, 31), noise=0.02))) for _ in range(20)
    ]
    late = [kinds.get("peak passed", math.inf) for kinds in passed]
    assert np.median(late) == pytest.approx(PEAK_KL, rel=0.25)


def test_a_gold_score_that_rises_with_the_proxy_gives_hardly_an_alarm():
    """Forty evaluations of a run that improves all the time."""
    rng, alarms = np.random.default_rng(5), 0
    for _ in range(50):
        points = [(kl, 0.3 * math.sqrt(kl) + 0.02 * rng.standard_normal()) for kl in np.linspace(0, 10, 40)]
        alarms += bool(followed(Monitor(), points))
    assert alarms <= 10


def test_proxy_up_and_gold_down_is_over_optimisation():
    rng = np.random.default_rng(6)
    gold = [1.0 + 0.05 * i for i in range(10)] + [1.5 - 0.05 * i for i in range(12)]
    points = [(5.0, g + 0.01 * rng.standard_normal()) for g in gold]
    monitor = Monitor()
    places = {}
    for index, (kl, value) in enumerate(points):
        for alarm in monitor.add(kl, 0.1 * index, value):
            places[alarm.kind] = index
            assert "kl_beta" in alarm.text and not alarm.stop
    assert 10 + TREND_WINDOWS[0] // 2 <= places["over-optimised"] <= 10 + TREND_WINDOWS[0]


@pytest.mark.parametrize("direction", [-1.0, 0.0])
def test_a_gold_score_that_falls_with_the_proxy_or_beside_a_flat_one_is_another_matter(direction):
    monitor = Monitor()
    points = [(5.0, 1.0 - 0.05 * i) for i in range(20)]
    assert followed(monitor, points, proxy=[direction * i for i in range(20)]) == []


def test_a_flat_gold_score_is_hardly_ever_called_a_fall():
    rng, alarms = np.random.default_rng(7), 0
    for _ in range(100):
        points = [(5.0, rng.standard_normal()) for _ in range(60)]
        alarms += any(kind == "over-optimised" for kind, _ in followed(Monitor(), points))
    assert alarms <= 10


def test_the_budget_stops_the_run():
    monitor = Monitor(kl_budget=6.0)
    assert monitor.add(5.99, 1.0) == []
    for _ in range(2):
        (alarm,) = monitor.add(6.0, 1.0)
        assert alarm.stop and alarm.kind == "kl budget" and "6" in alarm.text
    assert Monitor().add(1e6, 1.0) == []


@pytest.mark.parametrize("kl", [math.nan, math.inf])
def test_a_kl_that_is_no_number_is_an_error(kl):
    """Compared with a budget, NaN would never stop anything."""
    with pytest.raises(ValueError, match=f"KL to the reference is {kl}"):
        Monitor(kl_budget=1.0).add(kl, 1.0)


@pytest.mark.parametrize("budget", [0.0, -1.0, math.nan])
def test_a_budget_is_above_zero(budget):
    with pytest.raises(ValueError, match="kl_budget"):
        Monitor(kl_budget=budget)


def test_updates_without_gold_or_proxy_are_no_points():
    monitor = Monitor()
    for kl in range(10):
        monitor.add(float(kl), 1.0)
        monitor.add(float(kl), 1.0, math.nan)
    assert monitor.fit.points == 0 and not monitor.fit.decided
    for kl in range(TREND_WINDOWS[-1]):
        assert all(alarm.kind != "over-optimised" for alarm in monitor.add(float(kl), math.nan, -1.0 * kl))


def test_few_points_on_the_curve_decide_where_the_top_is():
    monitor = Monitor()
    for kl in (0.0, 2.0, 5.0, 9.0, 14.0):
        monitor.add(kl, kl, float(curve(kl)))
    assert monitor.fit.decided
    assert monitor.fit.peak_kl == pytest.approx(PEAK_KL, rel=1e-6)


@given(cut=st.integers(0, 30))
def test_a_restored_monitor_continues_without_a_difference(cut):
    rng = np.random.default_rng(8)
    points = noisy_run(rng, np.linspace(0, 40, 30), noise=0.02)
    proxy = [math.nan if i == 3 else float(i) for i in range(30)]
    whole, first, second = Monitor(), Monitor(), Monitor()
    expected = followed(whole, points, proxy)
    alarms = followed(first, points[:cut], proxy[:cut])
    second.restore(json.loads(json.dumps(first.state(), allow_nan=False)))
    alarms += followed(second, points[cut:], proxy[cut:])
    assert alarms == expected and second.fit == whole.fit


# ------------------------------------------------------------------------------------- the test of a slope


@given(st.lists(st.floats(-10, 10).map(lambda x: round(x, 3)), min_size=4, max_size=20))
def test_rising_is_the_one_sided_test_of_regression(values):
    assume(np.ptp(values) > 1e-6)
    result = linregress(np.arange(len(values)), values)
    assume(abs(result.rvalue) < 1 - 1e-9)
    expected = result.pvalue / 2 if result.slope > 0 else 1 - result.pvalue / 2
    assert trend_p_value(np.array(values)) == pytest.approx(expected, abs=1e-6)


def test_rising_of_straight_lines():
    steps = np.arange(6.0)
    assert (trend_p_value(steps), trend_p_value(-steps), trend_p_value(0 * steps)) == (0.0, 1.0, 1.0)
