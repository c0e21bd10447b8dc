"""Quantiles from buckets compared with exact ones."""

import json
import random

import pytest

from server.observability.histogram import BUCKETS, Histogram, _bucket, _upper_us, between


def test_buckets_are_contiguous_and_narrow() -> None:
    for us in [*range(5000), 10**5, 10**6, 2**31 - 1]:
        bucket = _bucket(us)
        upper = _upper_us(bucket)
        assert us < upper <= max(us + 1, us * 1.0626 + 1)
        assert _bucket(upper - 1) == bucket
        assert _bucket(upper) == min(bucket + 1, BUCKETS - 1)


@pytest.mark.parametrize("seed", range(5))
def test_quantiles_are_upper_bounds_within_a_bucket(seed: int) -> None:
    rng = random.Random(seed)
    values = [rng.expovariate(1000) for _ in range(rng.randrange(1, 3000))]
    histogram = Histogram()
    for value in values:
        histogram.record(value)
    for q in (0.5, 0.99):
        exact_ms = sorted(values)[max(0, -int(-q * len(values) // 1) - 1)] * 1e3
        assert exact_ms - 1e-9 <= histogram.quantile_ms(q) <= exact_ms * 1.0626 + 0.002
    assert histogram.summary()["max"] == round(max(values) * 1e3, 3)


def test_what_is_out_of_range_is_kept_in_the_outer_buckets() -> None:
    histogram = Histogram()
    histogram.record(-0.001)
    histogram.record(1e6)
    assert (histogram.buckets[0], histogram.buckets[-1], histogram.max_s) == (1, 1, 1e6)


def test_nothing_recorded_and_reset() -> None:
    histogram = Histogram()
    assert histogram.summary() == {"p50": 0, "p99": 0, "max": 0}
    histogram.record(0.25)
    assert histogram.summary() == {"p50": 250, "p99": 250, "max": 250}
    histogram.reset()
    assert histogram == Histogram()


@pytest.mark.parametrize("seed", range(5))
def test_a_window_has_the_figures_of_what_was_recorded_in_it(seed: int) -> None:
    rng = random.Random(seed)
    whole, window = Histogram(), Histogram()
    for _ in range(rng.randrange(2000)):
        whole.record(rng.expovariate(10))
    before = json.loads(json.dumps(whole.counts()))
    for _ in range(rng.randrange(1, 2000)):
        value = rng.expovariate(1000)
        whole.record(value)
        window.record(value)
    found = between(before, json.loads(json.dumps(whole.counts())))
    exact = window.summary()
    assert (found["p50"], found["p99"]) == (exact["p50"], exact["p99"])
    assert exact["max"] <= found["max"] <= exact["max"] * 1.0626 + 0.002


def test_a_window_in_which_nothing_happened() -> None:
    histogram = Histogram()
    assert histogram.counts() == []
    histogram.record(5.0)
    assert between(histogram.counts(), histogram.counts()) == {"p50": 0, "p99": 0, "max": 0}
