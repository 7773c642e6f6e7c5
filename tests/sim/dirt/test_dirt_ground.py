"""Snow and grass: ground returns rise by as much as lies on it."""

from __future__ import annotations

import numpy as np
import pytest
from yard import yard

from coview_stream.errors import ConfigError
from coview_stream.sim.dirt.scan import Surfaces
from coview_stream.sim.dirt.scene import Cover, Grass, Snow

RNG = np.random.default_rng


def lifts(snow, grass, y, slope=-1.0):
    """Heights above the ground of the returns of beams that come down at ``y`` metres beside the road's middle."""
    scene = yard()
    surfaces = Surfaces(scene, Cover(scene.site, snow, grass, RNG(1)), None, RNG(2))
    x = np.linspace(-40, 40, 3000)
    ray = np.array([np.sqrt(1 - slope**2), 0.0, slope])
    ends = np.column_stack([x, np.full(3000, y), np.zeros(3000)])
    origins = ends - 20.0 * ray
    echoes = surfaces.echoes(origins.astype(np.float32), np.tile(ray, (3000, 1)).astype(np.float32), RNG(3))
    return origins[:, 2] + echoes.distance * slope


def test_bare_ground_is_where_it_was():
    np.testing.assert_allclose(lifts(None, None, 10.0), 0.0, atol=1e-3)


@pytest.mark.parametrize("depth", [0.1, 0.4])
def test_snow_lifts_the_ground_by_its_depth_and_less_on_the_road(depth):
    snow = Snow(depth=depth, on_roads=0.5, drifts=0.1)
    assert lifts(snow, None, 10.0) == pytest.approx(depth, rel=0.11)
    assert lifts(snow, None, 0.0) == pytest.approx(0.5 * depth, rel=0.11)
    assert np.ptp(lifts(snow, None, 10.0)) > 0.01 * depth  # it drifts


def test_beams_end_within_the_grass_and_on_the_bare_road():
    grass = Grass(height=0.4, reach=0.3, tussocks=0.0)
    down, flat = lifts(None, grass, 12.0), lifts(None, grass, 12.0, slope=-0.2)
    for lift in (down, flat):
        assert lift.min() > -1e-3
        assert lift.max() < 0.4 + 1e-3
    assert 0.05 < (down < 1e-3).mean() < 0.95  # some come to the ground
    assert np.mean(flat) > np.mean(down) + 0.05  # flat beams end higher up
    np.testing.assert_allclose(lifts(None, grass, 0.0), 0.0, atol=1e-3)


def test_snow_buries_lower_grass():
    snow, grass = Snow(depth=0.5, drifts=0.0), Grass(height=0.3, tussocks=0.0)
    np.testing.assert_allclose(lifts(snow, grass, 12.0), 0.5, atol=2e-3)


@pytest.mark.parametrize(("settings", "name"), [(Snow, "depth"), (Snow, "on_roads"), (Grass, "height")])
def test_settings_out_of_range_are_refused(settings, name):
    with pytest.raises(ConfigError, match=name):
        settings(**{name: 5.0})
