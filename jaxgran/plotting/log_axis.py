"""Numbers at a logarithmic axis: two to seven, at a part of a decade or at many, so that none overprints another."""

import math

import numpy as np
from matplotlib.axis import Axis
from matplotlib.ticker import FixedFormatter, FixedLocator, LogLocator, MaxNLocator, NullFormatter, NullLocator

from jaxgran.plotting.drawing import scientific

_IN_A_DECADE = ((1, 1.5, 2, 3, 4, 6, 8), (1, 2, 5), (1, 3), (1,))  # fine to coarse
_LEAST = 2  # numbers at an axis
_MOST, _MOST_LONG = 7, 5  # numbers at an axis; 3 × 10⁻⁴ takes more room than 0.3 or 10⁻⁴
_PLAIN = 1e-3, 1e4  # a range within these limits is written without powers of ten
_ROUNDING = 1e-9  # relative, of the ends of a range


def number_log_axis(axis: Axis, low: float, high: float) -> None:
    """Put numbers at a logarithmic axis whose range is known; parts of a decade have marks where they have room."""
    plain = _PLAIN[0] <= low and high <= _PLAIN[1]
    numbers = log_numbers(low, high, _MOST if plain else _MOST_LONG)
    axis.set_major_locator(FixedLocator(numbers.tolist()))
    axis.set_major_formatter(FixedFormatter([f"{x:g}" if plain else f"${scientific(x)}$" for x in numbers]))
    axis.set_minor_locator(LogLocator(subs=range(1, 10)) if high >= 10 * low else NullLocator())
    axis.set_minor_formatter(NullFormatter())


def log_numbers(low: float, high: float, most: int) -> np.ndarray:
    """Return round numbers in a range: as fine a series as has few enough, or equal steps in a narrow range.

    A series has at most `most` numbers, and one of powers of ten at most seven.
    """
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    series = [np.array([part * 10.0**decade for decade in decades for part in parts]) for parts in _IN_A_DECADE]
    series = [one[(one >= low * (1 - _ROUNDING)) & (one <= high * (1 + _ROUNDING))] for one in series]
    numbers = next((one for one in series if len(one) <= most), series[-1])
    if len(numbers) < _LEAST:
        steps = np.asarray(MaxNLocator(most - 1, steps=(1, 2, 4, 5, 10)).tick_values(low, high))
        return steps[(steps >= low) & (steps <= high)]
    return numbers[:: math.ceil(len(numbers) / _MOST)]
