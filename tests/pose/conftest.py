"""The graph's backends, as far as they are installed."""

from __future__ import annotations

import pytest
from chains import NO_GTSAM

from coview_stream.config import GraphConfig
from coview_stream.pose.graph import make_smoother


@pytest.fixture(params=["numpy", "gtsam"])
def backend(request):
    if request.param == "gtsam":
        pytest.importorskip("gtsam", reason=NO_GTSAM)
    return request.param


@pytest.fixture
def smoother(backend):
    return make_smoother(GraphConfig(backend=backend))
