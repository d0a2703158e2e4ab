"""Numbers have suitable digits, downsampled series keep their peaks, and tables fit."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from symbid_ros.report.content import METRICS, MethodResult
from symbid_ros.report.formatting import fixed, shared_decimals, significant
from symbid_ros.report.plotting import downsample
from symbid_ros.report.table import metrics_table


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


class TestThin:
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


class TestTable:
    methods = (
        MethodResult("prior", None, dict.fromkeys((m.key for m in METRICS), 12.3)),
        MethodResult("WLS-RC", None, dict.fromkeys((m.key for m in METRICS), 0.456)),
        MethodResult("OLS", None, dict.fromkeys((m.key for m in METRICS), 11813.0)),
        MethodResult("truth", None, dict.fromkeys((m.key for m in METRICS), 3.2e-12)),
        MethodResult("unmeasured", None, None),
    )

    def printed(self, *, colours: bool = False) -> str:
        stream = io.StringIO()
        console = Console(
            file=stream,
            width=80,
            force_terminal=colours,
            color_system="standard" if colours else None,
        )
        console.print(metrics_table(self.methods))
        return stream.getvalue()

    def test_fits_in_80_columns(self) -> None:
        lines = self.printed().splitlines()
        assert max(map(len, lines)) <= 80
        assert next(line for line in lines if "OLS" in line).split() == ["OLS", *["11813"] * 5]
        assert "…" not in self.printed()

    def test_the_best_is_bold_and_the_truth_does_not_compete(self) -> None:
        bold = "\x1b[1m"
        lines = self.printed(colours=True).splitlines()
        assert next(line for line in lines if "WLS-RC" in line).count(bold) == 5
        assert bold not in next(line for line in lines if "truth" in line)

    def test_a_missing_metric_is_a_dash(self) -> None:
        line = next(line for line in self.printed().splitlines() if "unmeasured" in line)
        assert line.split()[1:] == ["—"] * 5
