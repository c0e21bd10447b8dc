"""Chance that every machine computes alike, from whole numbers."""

_MASK64 = (1 << 64) - 1


def drawn(n: int, *seeds: int) -> int:
    """Returns a whole number from 0 to n - 1, which depends on all seeds; `n` is at most 2^32."""
    value = 0
    for seed in seeds:
        value = _mixed(value ^ seed)
    return (value >> 32) * n >> 32


def _mixed(value: int) -> int:
    """Returns a 64-bit number whose bits all depend on all bits of another one."""
    value = (value + 0x9E3779B97F4A7C15) & _MASK64
    value = ((value ^ value >> 30) * 0xBF58476D1CE4E5B9) & _MASK64
    value = ((value ^ value >> 27) * 0x94D049BB133111EB) & _MASK64
    return value ^ value >> 31
