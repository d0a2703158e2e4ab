"""Numbers have suitable digits, and downsampled series keep their peaks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from symbid_ros.report.formatting import counted, fixed, shared_decimals, significant, with_std
from symbid_ros.report.plotting import downsample


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (26.04, "26.0"),
        (0.1234, "0.123"),
        (11813.4, "11813"),
        (-1.5, "-1.50"),
        (3.21e-7, "3.2e-07"),
        (4.5e9, "4.5e+09"),
        (float("nan"), "—"),
        (float("inf"), "—"),
        (None, "—"),
    ],
)
def test_significant(value: float | None, text: str) -> None:
    assert significant(value) == text


@given(st.floats(min_value=1e-3, max_value=9.9e5))
def test_significant_is_within_half_a_digit(value: float) -> None:
    assert float(significant(value)) == pytest.approx(value, rel=5.01e-3)


@pytest.mark.parametrize(("values", "decimals"), [([13.5, 0.02], 3), ([0.0049], 7), ([0.0], 4)])
def test_decimals_are_shared_by_a_column(values: list[float], decimals: int) -> None:
    assert shared_decimals(values) == decimals


@pytest.mark.parametrize(
    ("value", "text"), [(-0.5, "−0.50"), (-1e-9, "0.00"), (None, "—"), (1234.5, "1234.50")]
)
def test_fixed(value: float | None, text: str) -> None:
    assert fixed(value, 2) == text


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (4.432741, 0.00037, "4.43274 ± 0.00037"),
        (-0.00026, 0.00029, "−0.00026 ± 0.00029"),
        (2.5e-6, 2.9e-6, "(2.5 ± 2.9)e−06"),
        (-1.2e-5, 3e-8, "(−1.2000 ± 0.0030)e−05"),
        (0.0, 2.9e-8, "(0.0 ± 2.9)e−08"),
        (1.7, 0.0, "1.70"),
    ],
)
def test_a_value_has_the_digits_of_its_deviation(value: float, std: float, text: str) -> None:
    assert with_std(value, std) == text


class TestDownsample:
    @given(st.integers(1, 5000), st.integers(1, 400), st.integers(0, 2**32 - 1))
    def test_keeps_extremes_order_and_bound(self, samples: int, half: int, seed: int) -> None:
        value = np.random.default_rng(seed).normal(size=samples)
        time = np.arange(samples, dtype=np.float64)
        kept_time, kept = downsample(time, value, 2 * half)
        assert len(kept) <= max(2 * half, 1)
        assert (kept.min(), kept.max()) == (value.min(), value.max())
        assert np.all(np.diff(kept_time) > 0)
        np.testing.assert_array_equal(kept, value[kept_time.astype(int)])

    def test_returns_a_short_series_unchanged(self) -> None:
        value = np.array([3.0, 1.0, 2.0])
        np.testing.assert_array_equal(downsample(np.arange(3.0), value, 10)[1], value)


def test_one_thing_is_singular() -> None:
    assert [counted(n, "period") for n in (0, 1, 1.0, 2.5)] == [
        *("0 periods", "1 period", "1 period", "2.5 periods"),
    ]


def test_a_count_keeps_all_digits() -> None:
    assert counted(12_345_678, "message") == "12345678 messages"
