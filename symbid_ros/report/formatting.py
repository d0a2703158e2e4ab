"""Formatting of numbers for readers, with few significant digits."""

import math
from collections.abc import Iterable

ABSENT = "—"
SMALL = 1e-4  # below which a value and its deviation would have four leading zeros or more


def counted(number: float, noun: str) -> str:
    """Return a number with its noun, such as ``1 alarm`` or ``2 alarms``."""
    return f"{number:.10g} {noun}{'' if number == 1 else 's'}"


def significant(value: float | None, digits: int = 3) -> str:
    """Format ``value`` with ``digits`` significant digits, or a dash for None, NaN or infinity.

    Values from 1e-3 to 1e6 are decimal, others scientific with two digits.
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
    """Return the decimals that give the largest of ``values`` ``digits`` significant digits.

    With equal decimals, the values of a column can be compared at a glance.
    """
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    if largest == 0:
        return digits - 1
    return min(12, max(0, digits - 1 - math.floor(math.log10(largest))))


def fixed(value: float | None, decimals: int) -> str:
    """Return ``value`` with ``decimals`` decimals, or a dash for None, NaN or infinity."""
    if value is None or not math.isfinite(value):
        return ABSENT
    # A minus sign is as wide as a digit, unlike a hyphen. A rounded zero has no sign.
    text = f"{value:.{decimals}f}"
    return text.replace("-", "−") if float(text) else text.lstrip("-")


def with_std(value: float, std: float) -> str:
    """Format ``value ± std`` with two significant digits of ``std``.

    The value stands alone if ``std`` is zero, negative or not finite. It has one digit where
    rounding would leave zero of it. Small numbers share a power of ten, ``(2.5 ± 2.9)e−06``.
    """
    if not (math.isfinite(std) and std > 0):
        return significant(value)
    largest = max(abs(value), std)
    if largest < SMALL:
        exponent = -math.floor(math.log10(largest))
        return f"({with_std(value * 10.0**exponent, std * 10.0**exponent)})e−{exponent:02}"
    decimals = shared_decimals([std], 2)
    shown = fixed(value, decimals)
    if decimals == 0 and shown == "0":
        shown = significant(value, 1).replace("-", "−")
    return f"{shown} ± {fixed(std, decimals)}"
