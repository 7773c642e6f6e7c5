"""Places that a search might have scored, with probabilities of our choice, and votes that name chosen places."""

from dataclasses import replace

import numpy as np
import small_world
from small_world import Box

from coview_kernels import Registration
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import AcceptanceConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.evidence.observation import Evidence
from coview_stream.localization.search.acceptance import SearchResult, decide
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.places import Scored
from coview_stream.localization.search.request import SearchRequest


class Votes:
    """Consensus of keyframes whose places a test replaces: ``name`` gets those of the real one."""

    def __init__(self, consensus, name):
        self.consensus, self.name, self.centre = consensus, name, None

    def __len__(self):
        return len(self.consensus)

    def vote(self, centre, query, area=None):
        self.centre = centre
        self.consensus.vote(centre, query, area)

    def hypotheses(self):
        return self.name(self.consensus.hypotheses())

    def alike(self, T_map_odom):
        return self.consensus.alike(T_map_odom)

    def clear(self):
        self.consensus.clear()


def name_instead(search, name=lambda _: []):
    """Have the co-view votes of a search name other places, by default none; the votes."""
    search.coview.consensus = votes = Votes(search.coview.consensus, name)
    return votes


RULE = AcceptanceConfig()
NOTHING = np.empty((0, 3), dtype=np.float32)
REQUEST = SearchRequest(7.0, pose_from(rot_z(0.3), [40.0, -25.0, 1.2]), NOTHING, NOTHING, NOTHING, 5.5, (2, 3))
HERE = pose_from(rot_z(-0.8), [3.0, 9.0, 0.5])  # map <- odometry


def moved(forward=0.0, degrees=0.0):
    """``HERE`` with the robot (not the odometry's origin) moved and turned."""
    body = HERE @ REQUEST.T_odom_body @ pose_from(rot_z(np.radians(degrees)), [forward, 0.0, 0.0])
    return body @ inverse(REQUEST.T_odom_body)


def map_of(boxes):
    """The map of a site of boxes."""
    return BaseMap.build(small_world.sample_map(boxes).astype(np.float32), radius=30.0)


def rows_of_boxes():
    """Equal boxes on a square grid, to the map's edge."""
    middles = np.arange(-28.0, 29.0, 8.0)
    return [Box(np.array([x, y]), np.array([3.0, 3.0, 3.0]), 0.0) for x in middles for y in middles]


def place(probability, T_map_odom=HERE, score=0.7, hinted=False, **hypothesis):
    given = {"station": 5, "shift": 2, "votes": -3.0} | hypothesis
    return Hypothesis(T_map_odom, hinted=hinted, score=score, probability=probability, **given)


def candidate(at, score=0.8):
    """What comes of a place once it is registered."""
    fit = Registration(at.T_map_odom, 1e4 * np.eye(6), 0.05, 2000, 20, True)
    return replace(at, registration=fit, evidence=Evidence(score, score, 1.0, 1.0, 0.9))


def judged(*places, error=None, by_chance=1e-3, leader=True, risk=RULE.risk, undecided=0.0) -> SearchResult:
    """The decision on places, the most probable first; what is left of the probability is "none of these"."""
    none = 1.0 - sum(each.probability for each in places)
    if error is None:
        error = 1.0 - places[0].probability if places else 1.0
    second = places[1] if len(places) > 1 else None
    scored = Scored(len(places), list(places), error, none, by_chance, second)
    best = candidate(places[0]) if leader and places else None
    return decide(scored, best, REQUEST, AcceptanceConfig(risk=risk), undecided)
