"""Places that a search considers: from the search's result to the network, while there is no place."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from fake_node import publish_statuses
from fake_robot import SHA, search_request, search_result, tracking, unknown

from coview_stream.basemap.basemap import BaseMap
from coview_stream.errors import TransportError
from coview_stream.localization.search.considered import Considered
from coview_stream.messages.json_messages import decode_hypotheses
from coview_stream.stream.node.robot_endpoints import MapViewAnswer
from coview_stream.stream.node.status import hypotheses

PLACES = Considered(1.5, np.array([[1.0, 2.0, 3.0, 0.5, 0.7, 9.0], [4.0, 5.0, 6.0, -0.5, 0.1, 2.0]]), 0.2)


@pytest.fixture
def searched(site):
    """The session of a robot that has been searched for once, in vain."""
    session = site.sessions["r1"]
    site.engine.answer = lambda job: unknown(job, ask=search_request())
    site.sees("r1", 0.0)
    site.node.feeds[0].work("track", session, session.take_job("track"))
    session.handle_result(session.take_job("search"), replace(search_result(), considered=PLACES), time.monotonic())
    return session


def published(site, all_robots=True):
    publish_statuses(site.node, time.monotonic(), all_robots)
    return [decode_hypotheses(s) for s in site.net.samples(site.keys["r1"].hypotheses)]


def test_nothing_is_published_before_a_search(site):
    assert published(site) == []


def test_places_go_out_with_the_status_of_each_second(site, searched):
    assert published(site, all_robots=False) == []  # a change of state brings none
    (message,) = published(site)
    assert np.allclose(message.places, PLACES.places)
    assert (message.none, message.stamp_ns, message.map_sha256) == (0.2, 1_500_000_000, SHA)


def test_of_a_robot_with_a_place_nothing_goes_out(site, searched):
    site.engine.answer = tracking
    site.frame("r1", 0.1)
    assert searched.state()[0].has_place
    assert published(site) == []


def test_a_new_odometry_frame_forgets_them(site, searched):
    assert hypotheses(searched) is not None
    searched.restart_search("asked to search again", forget=True)
    assert hypotheses(searched) is None


def test_a_map_view_is_of_the_map_that_is_served(site, world_file):
    served = [BaseMap.load(world_file).sha256]
    key = site.keys["r1"].map_view
    site.net.answer(key, MapViewAnswer({served[0]: world_file, "00": world_file}, lambda: served[0]))
    view = site.net.query(key)
    assert view["map_sha256"] == served[0]
    assert view["count"] > 1000
    assert site.net.query(key) is view  # made once
    served[0] = "00"
    with pytest.raises(TransportError, match="another map"):
        site.net.query(key)
