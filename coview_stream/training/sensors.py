"""Sensors of training drives: the simulator's, and FGLoc6D's VLP-16, inclined by 45 degrees and rotating as a whole."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.sim.sensors import FRAME_PERIOD, SENSORS, Sensor

INCLINATION = float(np.radians(45.0))
"""Of the sensor's own axis, radians; set by hand."""

TURNS = 0.5
"""Turns of the whole sensor about the vertical, per second; set by hand."""

_COLUMNS = 1800
_ROTATING = "vlp16-inclined"

TRAINED_SENSORS = (*SENSORS, _ROTATING)
"""Names for :func:`trained_sensor`."""

_GROUP = {"vlp16": 16, "os64": 64, "os64-2048": 64, _ROTATING: 16}  # beams fired together


def trained_sensor(name: str, stride: Callable[[int], int] | None = None) -> Sensor:
    """Make a sensor by its name; ``stride`` maps its number of beams to n: only every n-th column is cast."""
    sensor = _inclined() if name == _ROTATING else SENSORS[name]()
    every = 1 if stride is None else max(1, stride(len(sensor.beams(0))))
    if every == 1:
        return sensor
    group, beams = _GROUP.get(name, 1), sensor.beams

    def thinned(frame: int) -> Floats:
        rays = beams(frame)
        # another column in each frame, so that together they cover all
        return np.asarray(rays[(np.arange(len(rays)) // group + frame) % every == 0])

    return Sensor(name, thinned, sensor.min_range, sensor.max_range)


def _inclined() -> Sensor:
    upright = SENSORS["vlp16"]()
    rays = upright.beams(0)
    c, s = np.cos(INCLINATION), np.sin(INCLINATION)
    leaning = rays @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    within = np.arange(len(rays)) // (len(rays) // _COLUMNS) / _COLUMNS

    def beams(frame: int) -> Floats:
        angle = 2 * np.pi * TURNS * FRAME_PERIOD * (frame + within)
        c, s = np.cos(angle), np.sin(angle)
        x, y, z = leaning.T
        return np.column_stack([c * x - s * y, s * x + c * y, z])

    return Sensor(_ROTATING, beams, upright.min_range, upright.max_range)
