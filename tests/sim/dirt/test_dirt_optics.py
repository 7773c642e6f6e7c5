"""Faults of the light: wide beams, rain, dust, blooming signs, windows."""

import numpy as np
import pytest
from yard import fan, scanned, yard

from coview_stream.sim.dirt import Dirt
from coview_stream.sim.dirt.optics import Beams, Dust, Glass, Rain, Reflectors, windows
from coview_stream.sim.dirt.scan import Surfaces
from coview_stream.sim.mesh import box, placed

RNG = np.random.default_rng


def edge():
    """A post in the way of a wall half a metre behind it."""
    return yard(placed(box(0.3, 4, 6), 10.15, 0), placed(box(0.3, 40, 6), 10.85, 0))


def test_echoes_mix_at_edges_only_when_beams_are_wide():
    wide, narrow = (scanned(edge(), dirt) for dirt in (Dirt(beams=Beams(noise=0.0)), Dirt(mounting=None, dust=Dust())))

    def between(points):
        """Share of the points beside the post's edge whose distance is neither the post's nor the wall's."""
        beside = points[(np.abs(np.abs(points[:, 1]) - 2.0) < 0.1) & (points[:, 0] > 9)]
        return float(((beside[:, 0] > 10.15) & (beside[:, 0] < 10.55)).mean())

    assert between(wide) > 0.03
    assert between(narrow) == 0.0


def test_surfaces_farther_apart_than_a_pulse_do_not_mix():
    distance, share = Beams(pulse=0.8).mixed(np.full(1000, 5.0), np.full(1000, 9.0), RNG(0))
    assert set(distance) == {5.0, 9.0}
    assert set(share) == {0.0, 1.0}
    sky, _ = Beams().mixed(np.full(5, np.inf), np.full(5, np.inf), RNG(0))
    assert np.isinf(sky).all()
    half, _ = Beams().mixed(np.full(5, np.inf), np.full(5, 7.0), RNG(0))
    np.testing.assert_array_equal(half, 7.0)


def test_rays_aside_stay_within_the_beam():
    rays = fan()
    apart = np.arccos(np.clip(np.einsum("ij,ij->i", rays, Beams(divergence=4.0).aside(rays, RNG(0))), -1, 1))
    assert apart.max() < 2.01e-3
    assert np.mean(apart) == pytest.approx(2e-3 * 2 / 3, rel=0.1)  # evenly over the disc


def test_noise_grows_with_the_range():
    def noise_at(distance):
        points = scanned(
            yard(placed(box(1, 80, 20), distance + 0.5, 0)), Dirt(beams=Beams(noise=0.002, divergence=0.0))
        )
        ahead = points[(points[:, 0] > 0.9 * distance) & (np.abs(points[:, 1]) < 3) & (points[:, 2] > 0)]
        return float(np.std(ahead[:, 0]))

    assert noise_at(5.0) == pytest.approx(np.hypot(0.02, 0.01), rel=0.15)
    assert noise_at(40.0) == pytest.approx(np.hypot(0.02, 0.08), rel=0.15)


def test_rain_fills_the_air_nearby_and_dims_what_is_far():
    scene = yard(placed(box(1, 100, 30), 55.0, 0))
    dry, wet = (scanned(scene, Dirt(rain=rain)) for rain in (Rain(drops=0.0, extinction=0.0), Rain(0.05, 4.0, 0.03)))

    def in_the_air(points):
        return (np.linalg.norm(points, axis=1) < 20.0) & (np.abs(points[:, 2]) < 1.0)

    assert in_the_air(dry).sum() == 0
    drops = wet[in_the_air(wet)]
    # 16 beams of which 12 are level enough for that zone
    assert 0.02 < len(drops) / 28_800 < 0.05
    assert np.median(np.linalg.norm(drops, axis=1)) == pytest.approx(4.0 * np.log(2) + 0.5, abs=0.7)
    far = [int((points[:, 0] > 50).sum()) for points in (dry, wet)]
    assert far[1] < 0.8 * far[0]


def test_dust_trails_behind_the_robot():
    dust = Dust(reach=1.0, gusts=0.0)
    clear, dusty = scanned(yard(), Dirt(rain=Rain(0.0, 1.0, 0.0))), scanned(yard(), Dirt(dust=dust))
    up = [points[(points[:, 2] > -1.4) & (np.linalg.norm(points, axis=1) < 12)] for points in (clear, dusty)]
    assert len(up[0]) < 5  # noise of the ground
    assert len(up[1]) > 300
    assert up[1][:, 0].max() < -dust.centre + dust.size[0] + 0.2
    assert np.abs(up[1][:, 1]).max() < dust.size[1] + 0.2
    assert up[1][:, 2].max() < 2 * dust.size[2] - 1.5 + 0.2


def test_signs_bloom():
    scene = yard(placed(box(1, 60, 12), 30.5, 0), poles=[(15.0, 0.0, 0.0, 0.7)])
    plain, blooming = scanned(scene, Dirt(dust=Dust(gusts=0.0))), scanned(scene, Dirt(reflectors=Reflectors(bloom=1.0)))

    def halo(points):
        """How far beside the sign points stand at its distance, metres."""
        level = points[(np.abs(points[:, 0] - 15.0) < 0.3) & (points[:, 2] > -1.2)]
        return np.abs(level[:, 1])

    assert halo(plain).max() < 0.45
    assert 0.5 < halo(blooming).max() < 15.0 * np.radians(2.6) + 0.4
    assert len(halo(blooming)) > 2 * len(halo(plain))


def test_nothing_blooms_behind_a_nearer_surface_or_far_away():
    rays, signs = fan(2.0, 101), np.zeros(101, bool)
    signs[50] = True
    near = np.where(signs, 20.0, 5.0)
    np.testing.assert_array_equal(Reflectors().halo(rays, near, signs, RNG(0)), near)
    far = np.where(signs, 60.0, 80.0)
    np.testing.assert_array_equal(Reflectors(reach=40.0).halo(rays, far, signs, RNG(0)), far)


def looked(glass):
    """Ranges of a fan of beams at the height of the windows, before a house 8 m deep, a shed behind the robot."""
    scene = yard(placed(box(8, 30, 9), 14, 0), placed(box(2, 200, 9), -21, 0))
    surfaces = Surfaces(scene, None, glass, RNG(0))
    rays = fan(30.0, 2001)
    origins = np.tile(np.array([0, 0, 1.7]), (2001, 1))
    echoes = surfaces.echoes(origins.astype(np.float32), rays.astype(np.float32), RNG(1))
    return rays, echoes


def test_what_glass_mirrors_lies_behind_it():
    rays, clear = looked(None)
    np.testing.assert_allclose(clear.distance * rays[:, 0], 10.0, atol=1e-3)
    _, mirrored = looked(Glass(share=1.0, mirrors=1.0, passes=0.0, strength=0.4))
    x = mirrored.distance * rays[:, 0]
    pane = x > 10.1
    assert 0.5 < pane.mean() < 0.95  # the rest are frames
    np.testing.assert_allclose(x[~pane], 10.0, atol=1e-3)
    # the shed's front at x = -20 is 30 m before the glass, and its image as far behind it
    np.testing.assert_allclose(x[pane], 40.0, atol=0.05)
    np.testing.assert_allclose(mirrored.strength[pane], 0.4 * rays[pane, 0], atol=1e-3)


def test_what_is_behind_clear_glass_is_seen_through_it():
    rays, seen = looked(Glass(share=1.0, mirrors=0.0, passes=1.0))
    x = seen.distance * rays[:, 0]
    inside = x > 10.1
    assert 0.5 < inside.mean() < 0.95
    assert x[inside].max() == pytest.approx(18.0, abs=0.05)  # the far wall from inside


def test_only_some_houses_have_windows():
    rays, none = looked(Glass(share=0.0, mirrors=1.0, passes=0.0))
    np.testing.assert_allclose(none.distance * rays[:, 0], 10.0, atol=1e-3)
    roof = np.tile([0.0, 0.0, 1.0], (50, 1))
    assert not windows(RNG(0).uniform(0, 50, (50, 3)), roof, np.full(50, 1.5)).any()
