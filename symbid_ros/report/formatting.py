"""Numbers as a reader wants them: few digits, no false precision."""

import math
from collections.abc import Iterable

ABSENT = "—"


def significant(value: float | None, digits: int = 3) -> str:
    """Return ``value`` with ``digits`` significant figures, a dash where there is none.

    Decimal notation from 1e-3 to 1e6; outside, scientific with two figures.
    """
    if value is None or not math.isfinite(value):
        return ABSENT
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if not -3 <= exponent < 6:
        return f"{value:.1e}"
    return f"{value:.{max(0, digits - 1 - exponent)}f}"


def shared_decimals(values: Iterable[float], digits: int = 5) -> int:
    """Return the decimals that give the largest of ``values`` ``digits`` significant figures.

    Columns of one unit get the same number of decimals, so that they can be
    read downwards.
    """
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    if largest == 0:
        return digits - 1
    return min(12, max(0, digits - 1 - math.floor(math.log10(largest))))


def fixed(value: float | None, decimals: int) -> str:
    """Return ``value`` with ``decimals`` decimals, a dash where there is none."""
    if value is None or not math.isfinite(value):
        return ABSENT
    # A true minus sign is as wide as the digits, and -0.000 is no number.
    text = f"{value:.{decimals}f}"
    return text.replace("-", "−") if float(text) else text.lstrip("-")


def with_std(value: float, std: float) -> str:
    """Return ``value ± std``, the deviation with two significant figures, the value with as many.

    Where there is no finite positive deviation, the value alone.
    """
    if not (math.isfinite(std) and std > 0):
        return significant(value)
    decimals = shared_decimals([std], 2)
    return f"{fixed(value, decimals)} ± {fixed(std, decimals)}"
