"""Distributions against those of SciPy."""

import numpy as np
import pytest
from scipy import special

from coview_stream.geometry.distributions import (
    beta_share,
    chi2_quantile,
    chi2_tail,
    f_quantile,
    log_beta,
    normal_quantile,
)


@pytest.mark.parametrize("freedom", [1, 2, 3, 6])
def test_chi2_tail_and_its_quantile(freedom):
    for value in (0.0, 1e-3, 0.7, 3.0, 20.0, 300.0):
        assert chi2_tail(freedom, value) == pytest.approx(special.chdtrc(freedom, value), rel=1e-12)
    for tail in (1e-12, 1e-3, 0.05, 0.5, 0.999):
        assert chi2_quantile(freedom, tail) == pytest.approx(special.chdtri(freedom, tail), rel=1e-9)


def test_normal_quantile_and_log_beta():
    for p in (1e-6, 0.3, 0.5, 0.999):
        assert normal_quantile(p) == pytest.approx(special.ndtri(p), rel=1e-12, abs=1e-15)
    for a, b in ((0.5, 0.5), (3.0, 70.0), (0.01, 9.0)):
        assert log_beta(a, b) == pytest.approx(special.betaln(a, b), rel=1e-12)


def test_beta_share():
    rng = np.random.default_rng(0)
    for a, b, x in zip(*rng.uniform(0.3, 30.0, (2, 100)), rng.uniform(0.0, 1.0, 100), strict=True):
        assert beta_share(a, b, x) == pytest.approx(special.betainc(a, b, x), rel=1e-10, abs=1e-14)
    assert (beta_share(2.0, 3.0, 0.0), beta_share(2.0, 3.0, 1.0)) == (0.0, 1.0)


@pytest.mark.parametrize("freedom", [2.7, 3.9, 20.0])
@pytest.mark.parametrize("tail", [1e-6, 1e-3, 0.05, 0.6])
def test_f_quantile(freedom, tail):
    for axes in (1.0, 1.2345, 2.5, 3.0):
        exact = special.fdtri(axes, freedom, 1.0 - tail)
        assert f_quantile(axes, freedom, tail) == pytest.approx(exact, rel=1e-8)
