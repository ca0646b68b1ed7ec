"""Numbers that hypothesis draws for tests of several rooms."""

import math

from hypothesis import strategies as st


def log_floats(low: float, high: float) -> st.SearchStrategy[float]:
    """Positive numbers, every decade as likely."""
    return st.floats(math.log10(low), math.log10(high)).map(lambda exponent: 10.0**exponent)


def or_zero(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[float]:
    """Zero as likely as all these numbers together."""
    return st.just(0.0) | numbers
