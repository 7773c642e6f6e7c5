"""The airborne-like survey: roofs and ground remain, facades and what is under roofs go, density as asked."""

import numpy as np
import pytest

from coview_stream.errors import ConfigError, InputError
from coview_stream.sim.airborne import Survey, airborne_survey, surface_of

SIZE, HEIGHT, EAVES = 6.0, 8.0, 1.5  # metres: half of a house, its walls, and how far the roof stands out
STEP = 0.15  # metres between points


def sheet(first, second):
    a, b = np.meshgrid(np.arange(*first, STEP), np.arange(*second, STEP), indexing="ij")
    return a.ravel(), b.ravel()


@pytest.fixture(scope="module")
def house():
    """Ground with a house of four walls, a flat roof with eaves and a floor, as a ground survey with 2 cm of noise."""
    x, y = sheet((-30.0, 30.0), (-30.0, 30.0))
    parts = [np.column_stack([x, y, np.zeros(len(x))])]
    for sign in (-1.0, 1.0):
        along, up = sheet((-SIZE, SIZE), (0.0, HEIGHT))
        parts.append(np.column_stack([along, np.full(len(along), sign * SIZE), up]))
        parts.append(np.column_stack([np.full(len(along), sign * SIZE), along, up]))
    x, y = sheet((-SIZE - EAVES, SIZE + EAVES), (-SIZE - EAVES, SIZE + EAVES))
    parts.append(np.column_stack([x, y, np.full(len(x), HEIGHT)]))
    points = np.concatenate(parts)
    return points + np.random.default_rng(3).normal(0.0, 0.02, points.shape)


def under(points, half):
    return (np.abs(points[:, :2]) < half).all(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("density", [4.0, 8.0, 20.0])
def test_roof_and_ground_remain_with_the_density_asked_for(house, density):
    seen = airborne_survey(house, Survey(density=density))
    roof = under(seen, SIZE) & (np.abs(seen[:, 2] - HEIGHT) < 0.3)
    ground = ~under(seen, SIZE + 6.0) & (np.abs(seen[:, 2]) < 0.3)
    assert roof.sum() / (2 * SIZE) ** 2 == pytest.approx(density, rel=0.3)
    assert ground.sum() / (60.0**2 - (2 * SIZE + 12.0) ** 2) == pytest.approx(density, rel=0.3)


@pytest.mark.slow
def test_facades_and_the_floor_under_the_roof_go(house):
    seen = airborne_survey(house, Survey(density=8.0))
    between = (seen[:, 2] > 0.5) & (seen[:, 2] < HEIGHT - 0.7)
    assert between.sum() < 0.002 * len(seen)
    inner = under(seen, SIZE - 1.0) & (seen[:, 2] < HEIGHT - 1.0)
    assert not inner.any()


def test_walls_without_a_roof_keep_their_tops_only():
    """As in a real ground survey, that has seen no roof: no return from inside."""
    along, up = sheet((-10.0, 10.0), (0.0, HEIGHT))
    x, y = sheet((-20.0, 20.0), (-20.0, 20.0))
    parts = [np.column_stack([along, np.full(len(along), 4.0), up]), np.column_stack([x, y, np.zeros(len(x))])]
    points = np.concatenate(parts) + np.random.default_rng(0).normal(0.0, 0.01, (len(along) + len(x), 3))
    seen = airborne_survey(points, Survey(density=16.0))
    above = seen[seen[:, 2] > 0.6]
    assert len(above) > 20
    assert above[:, 2].min() > HEIGHT - 1.0


@pytest.mark.slow
def test_foliage_lets_pulses_through_and_solid_surfaces_do_not():
    rng = np.random.default_rng(5)
    x, y = sheet((-15.0, 15.0), (-15.0, 15.0))
    ground = np.column_stack([x, y, rng.normal(0.0, 0.02, len(x))])
    crown = rng.uniform([-8.0, -8.0, 5.0], [8.0, 8.0, 7.0], (20_000, 3))
    points = np.concatenate([ground, crown])
    surface = surface_of(points)
    assert surface.foliage[len(ground) :].mean() > 0.9
    assert surface.foliage[: len(ground)].mean() < 0.02
    for porosity, least, most in ((0.0, 0.0, 0.25), (0.9, 1.0, 9.0)):
        seen = airborne_survey(points, Survey(porosity=porosity))
        below = under(seen, 5.0) & (seen[:, 2] < 0.5)
        assert least <= below.sum() / 100.0 <= most
        assert (under(seen, 5.0) & (seen[:, 2] > 4.0)).sum() / 100.0 > 6.0


@pytest.mark.slow
def test_noise_is_along_the_ray_and_strips_can_be_misaligned(house):
    far = ~under(house, SIZE + 8.0)
    exact = house[far] * [1.0, 1.0, 0.0]
    seen = airborne_survey(exact, Survey(noise=0.03))
    assert np.std(seen[:, 2]) == pytest.approx(0.03, rel=0.1)
    shifted = airborne_survey(exact, Survey(noise=0.0, misaligned=0.1, seed=2))
    assert np.std(shifted[:, 2]) > 0.02
    np.testing.assert_array_equal(shifted, airborne_survey(exact, Survey(noise=0.0, misaligned=0.1, seed=2)))


def test_what_cannot_be_flown_is_refused():
    with pytest.raises(InputError, match="places"):
        airborne_survey(np.zeros((5, 3)))
    with pytest.raises(ConfigError, match="swath"):
        Survey(swath=80.0)
