"""Places that a search considers, as people see them."""

from __future__ import annotations

import numpy as np
from fake_robot import search_request

from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.search.acceptance import MAX_PLACES, Considered
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.scoring import Rivals, Scored


def place(x, probability):
    T = pose_from(rot_z(0.5), [x, 2.0, 3.0])
    return Hypothesis(T, 1, 1, score=0.5, ratio=7.0, probability=probability)


def test_the_most_probable_come_first_in_the_frame_of_the_sources():
    scored = Scored(Rivals(), [place(float(k), 0.01 * k) for k in range(30)], none=0.25)
    found = Considered.of(scored, search_request(4.0), np.array([1000.0, 0.0, 50.0]))
    assert (found.stamp, found.none, len(found.places)) == (4.0, 0.25, MAX_PLACES)
    assert np.allclose(found.places[0], [1029.0, 2.0, 53.0, 0.5, 0.29, 7.0])


def test_no_place_is_nothing():
    assert Considered.of(Scored(Rivals(), []), search_request(), np.zeros(3)) is None


def test_a_search_brings_the_right_place_along(world_map, world_drive):
    localizer = Localizer(world_map)
    results = []
    for k, (cloud, T) in enumerate(zip(world_drive.clouds[:3], world_drive.T_odom_body[:3], strict=True)):
        request = localizer.add_frame(cloud, T, 0.5 * k)
        if request is not None:
            results.append((k, localizer.search.update(request)))
    number, result = results[0]
    distance = np.linalg.norm(result.considered.places[:, :2] - world_drive.T_map_body[number][:2, 3], axis=1)
    assert distance.min() < 1.0
