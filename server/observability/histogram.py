"""A histogram of durations. It takes the same memory for any number of durations."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

FINE = 32
"""Microseconds below which each has its own bucket. Above, each doubling has `FINE / 2` buckets, up to 6 % wide."""
BUCKETS = FINE + 26 * FINE // 2
"""Number of buckets. They reach to 2^31 us (35 minutes); the last one takes longer durations, too."""


def _bucket(us: int) -> int:
    if us < FINE:
        return max(us, 0)
    shift = us.bit_length() - FINE.bit_length() + 1
    return min(shift * (FINE // 2) + (us >> shift), BUCKETS - 1)


def _upper_us(bucket: int) -> int:
    """Returns the lowest duration above a bucket, in microseconds."""
    if bucket < FINE:
        return bucket + 1
    shift = bucket // (FINE // 2) - 1
    return (bucket - shift * (FINE // 2) + 1) << shift


@dataclass
class Histogram:
    """A histogram of durations that are given in seconds. Quantiles are in milliseconds, at most 6 % too high."""

    count: int = 0
    sum_s: float = 0.0
    max_s: float = 0.0
    buckets: list[int] = field(default_factory=lambda: [0] * BUCKETS)

    def record(self, seconds: float) -> None:
        self.count += 1
        self.sum_s += seconds
        self.buckets[_bucket(int(seconds * 1e6))] += 1
        if seconds > self.max_s:
            self.max_s = seconds

    def quantile_ms(self, q: float) -> float:
        """Returns an upper bound of the `q` quantile in milliseconds; 0 if nothing was recorded."""
        left = max(1.0, q * self.count)
        for bucket, n in enumerate(self.buckets):
            left -= n
            if n and left <= 0:
                return min(_upper_us(bucket) / 1e3, self.max_s * 1e3)
        return self.max_s * 1e3

    def summary(self) -> dict[str, float]:
        """Returns p50, p99 and max in milliseconds."""
        values = {"p50": self.quantile_ms(0.5), "p99": self.quantile_ms(0.99), "max": self.max_s * 1e3}
        return {name: round(value, 3) for name, value in values.items()}

    def counts(self) -> list[list[int]]:
        """Returns for each non-empty bucket, ascending: the lowest duration above it in us, and its count."""
        return [[_upper_us(bucket), n] for bucket, n in enumerate(self.buckets) if n]

    def below(self, bounds_s: Sequence[float]) -> list[int]:
        """Returns for each bound how many durations are certainly below it; a bucket around a bound does not count.

        Args:
            bounds_s: the bounds in seconds, ascending.
        """
        found, n, bucket = [], 0, 0
        for bound_s in bounds_s:
            while bucket < BUCKETS and _upper_us(bucket) <= bound_s * 1e6:
                n += self.buckets[bucket]
                bucket += 1
            found.append(n)
        return found

    def reset(self) -> None:
        """Forgets everything recorded."""
        self.count, self.sum_s, self.max_s = 0, 0.0, 0.0
        self.buckets = [0] * BUCKETS


def between(before: Iterable[Sequence[int]], after: Iterable[Sequence[int]]) -> dict[str, float]:
    """Returns p50, p99 and max in milliseconds of the durations recorded between two moments.

    Each is an upper bound, at most 6 % too high, and 0 if nothing was recorded.

    Args:
        before: the histogram's `counts` at the first moment.
        after: its `counts` at the second moment.
    """
    earlier = {pair[0]: pair[1] for pair in before}
    counts = [(upper, n - earlier.get(upper, 0)) for upper, n in after]
    total = sum(n for _, n in counts)

    def quantile_ms(q: float) -> float:
        left = max(1.0, q * total)
        for upper, n in counts:
            left -= n
            if n and left <= 0:
                return upper / 1e3
        return 0.0

    return {name: quantile_ms(q) for name, q in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))}
