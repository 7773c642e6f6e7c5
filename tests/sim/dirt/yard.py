"""A flat yard with what a test puts into it: no trees, no cars, a road along x."""

import numpy as np

from coview_stream.sim.dirt.scan import Scanner
from coview_stream.sim.layout import Layout, Site
from coview_stream.sim.scenes import Footprint, Parts, Scene
from coview_stream.sim.sensors import SENSORS

HALF = 60.0


def yard(*built, poles=(), road_width=3.0):
    """A scene of buildings (meshes, where they stand) and poles (x, y, yaw, kind)."""
    line = np.column_stack([np.arange(-HALF, HALF, 1.0), np.zeros(int(2 * HALF))])
    layout = Layout(line, (line,), road_width)
    site = Site(np.random.default_rng(0), layout, HALF, relief=0.0, roughness=0.0, ditch=0.0)
    rows = np.array(poles, dtype=float).reshape(-1, 4)
    parts = Parts(site.mesh(), tuple(built), (), (), np.zeros((0, 8)), np.zeros((0, 4)), rows)
    state = parts.state(site)
    footprints = tuple(Footprint(0, 0, 1, 1, 0, 0, 1) for _ in built)
    return Scene("town", 100.0, state, state, site, line, footprints, (parts, parts), tuple(range(len(built))))


def standing(count=1, height=1.5):
    """Poses of a robot that stands in the middle, facing +x."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = height
    return poses


def fan(degrees=60.0, count=4001, up=0.0):
    """Unit rays in a horizontal fan about +x, ``up`` above the horizon."""
    angle = np.radians(np.linspace(-degrees, degrees, count))
    rays = np.column_stack([np.cos(angle), np.sin(angle), np.full(count, np.tan(np.radians(up)))])
    return rays / np.linalg.norm(rays, axis=1)[:, None]


def vlp16():
    return SENSORS["vlp16"]()


def scanned(scene, dirt, frames=1):
    """Points of a standing robot, its body frame."""
    scanner = Scanner(scene, vlp16(), dirt, 1.5, lambda purpose: np.random.default_rng(int(purpose)))
    truth = standing(frames)
    return np.concatenate(list(scanner.frames(0.1 * np.arange(frames), truth, truth)))
