"""Parameters of tests that are slow ones."""

import pytest


def slow(*values):
    """Values of one parameter."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def slow_rows(*rows):
    """Rows of several parameters."""
    return [pytest.param(*row, marks=pytest.mark.slow) for row in rows]
