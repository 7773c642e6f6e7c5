"""Viewer of live poses (rerun): the robots' axes and paths, in the map frame."""

from __future__ import annotations

import numpy as np

from coview_stream.errors import require_library
from coview_stream.geometry.transforms import pose_to_tum
from coview_stream.messages.types import PoseMessage

_MAX_STRIP = 50  # poses of one line strip, set by hand: redrawing the whole path at each pose is quadratic
_COLOURS = ((220, 60, 60), (60, 180, 60), (70, 90, 230))  # x forward, y left, z up


class PoseViewer:
    """Window of the rerun viewer, opened on creation.

    The first position is the viewer's origin: it draws in float32, and maps may have UTM coordinates.

    Raises:
        DependencyError: rerun is not installed.
    """

    def __init__(self) -> None:
        self._rerun = require_library("rerun", "rerun-sdk>=0.20", "--rerun")
        self._origin: np.ndarray | None = None
        self._strips: dict[str, list[np.ndarray]] = {}
        self._pieces: dict[str, int] = {}
        self._rerun.init("coview_stream", spawn=True)

    def show(self, pose: PoseMessage) -> None:
        """Draw one pose and the path to it."""
        row = pose_to_tum(pose.T_map_body)
        if self._origin is None:
            self._origin = row[:3].copy()
        position = row[:3] - self._origin
        name = f"robots/{pose.robot}"
        if name not in self._strips:
            axes = self._rerun.Arrows3D(vectors=np.eye(3), colors=_COLOURS)
            self._rerun.log(f"{name}/body", axes, static=True)
        self._set_time(pose.stamp_ns)
        self._rerun.log(
            f"{name}/body", self._rerun.Transform3D(translation=position, rotation=self._rerun.Quaternion(xyzw=row[3:]))
        )
        self._extend(name, position)

    def _extend(self, name: str, position: np.ndarray) -> None:
        strip = self._strips.setdefault(name, [])
        strip.append(position)
        piece = self._pieces.setdefault(name, 0)
        if len(strip) > 1:
            self._rerun.log(f"{name}/way/{piece}", self._rerun.LineStrips3D([np.array(strip)]))
        if len(strip) >= _MAX_STRIP:
            self._strips[name] = [position]
            self._pieces[name] = piece + 1

    def _set_time(self, stamp_ns: int) -> None:
        if hasattr(self._rerun, "set_time"):
            self._rerun.set_time("sensor", timestamp=stamp_ns * 1e-9)
        else:  # before rerun 0.23
            self._rerun.set_time_nanos("sensor", stamp_ns)
