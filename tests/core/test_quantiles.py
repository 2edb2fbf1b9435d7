"""Tails and quantiles against the printed tables, and against the library that takes a second to import."""

import math
from pathlib import Path

import numpy as np
import pytest
import scipy

import autotuner
from autotuner.core.diagnosis.extended.coloured_noise import normality
from autotuner.core.quantiles import chi2_tail, f_tail, student_quantile


@pytest.mark.parametrize(("value", "freedom", "tail"), [(3.841, 1, 0.05), (18.307, 10, 0.05), (29.588, 10, 0.001)])
def test_chi_squared_as_tabulated(value, freedom, tail):
    assert chi2_tail(value, freedom) == pytest.approx(tail, rel=2e-3)


@pytest.mark.parametrize(("value", "above", "below", "tail"), [(3.493, 2, 20, 0.05), (5.636, 5, 10, 0.01)])
def test_fisher_as_tabulated(value, above, below, tail):
    assert f_tail(value, above, below) == pytest.approx(tail, rel=2e-3)
    assert f_tail(-0.1, above, below) == 1.0


@pytest.mark.parametrize(("freedom", "quantile"), [(1, 12.706), (10, 2.228), (1e9, 1.960)])
def test_student_as_tabulated(freedom, quantile):
    assert student_quantile(freedom) == pytest.approx(quantile, rel=2e-4)


def test_normality_by_hand():
    """1, 1, 1, 5: mean square 3, skewness 2/sqrt 3, kurtosis 7/3, so 4/6 (4/3 + 1/9) = 26/27."""
    values = np.array([1.0, 1.0, 1.0, 5.0])
    assert normality(values) == pytest.approx(math.exp(-13.0 / 27.0))
    assert normality(values) == pytest.approx(scipy.stats.jarque_bera(values).pvalue)


def test_no_computation_imports_what_takes_a_second_to_load():
    core = Path(autotuner.__file__).parent / "core"
    using = [p for p in core.rglob("*.py") if any(w in p.read_text() for w in ("scipy.stats.", "scipy.signal."))]
    assert [p.name for p in using] == ["oscillation.py"]  # of a loop that is watched for long
