"""Simulated worlds: an airborne base map and a robot's lidar run through the same seeded scene."""

from __future__ import annotations

from coview_stream.sim.dirt import Dirt, parse_dirt
from coview_stream.sim.kinds import KINDS
from coview_stream.sim.odometry import OdometryConfig
from coview_stream.sim.sensors import SENSORS
from coview_stream.sim.simulate import Simulated, SimulationConfig, simulate

__all__ = ["KINDS", "SENSORS", "Dirt", "OdometryConfig", "Simulated", "SimulationConfig", "parse_dirt", "simulate"]
