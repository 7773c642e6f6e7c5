"""An empty pose graph."""

from __future__ import annotations

import pytest

from coview_stream.localization.tracking.pose_graph import PoseGraph


@pytest.fixture
def graph():
    return PoseGraph()
