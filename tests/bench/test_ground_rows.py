"""Changes of the ground in ``bench ground``: where they are, and how deep."""

import numpy as np
import pytest

from bench.accuracy.ground import CASES

WAY = np.column_stack([np.arange(0.0, 60.0), np.zeros(60)])
FAR = np.array([500.0])


@pytest.mark.parametrize("case", CASES)
def test_ground_changes_near_the_way_alone_but_for_snow(case):
    change = CASES[case]
    on_way = change(*WAY.T, WAY)
    assert on_way.shape == (60,)
    assert np.abs(on_way).max() <= 3.0
    assert change(FAR, FAR, WAY) == pytest.approx(0.0 if "snow" not in case else 0.5, abs=0.06)
    if "starts" in case:
        assert abs(on_way[0]) >= 1.0
    if "drives" in case:
        assert on_way[0] == 0.0
        assert abs(on_way[30]) >= 2.0
    if case == "piles":
        assert not on_way.any()  # the robot drives between them
        x, y = (each.ravel() for each in np.meshgrid(np.arange(-20.0, 80.0), np.arange(-30.0, 30.0)))
        assert change(x, y, WAY).max() > 1.5
