"""Sink for rerun: its viewer on this machine, or a file to open later (``rerun-sdk``)."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import sysconfig
import time
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.basemap.summary import MapView
from coview_stream.errors import PIP_INSTALL, ConfigError, DependencyError, InputError, require_library
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, pose_to_tum, transform
from coview_stream.messages.types import HypothesesMessage, PoseMessage
from coview_stream.viewers.scene import Scan, Sink

_HOST = "127.0.0.1"
_MAX_START = 10.0  # seconds for the viewer to listen
_STRIP = 50  # poses per line strip: redrawing the whole path at each pose is quadratic
_SIGMAS = 3.0  # of the covariance ellipsoid
_AXES = ((220, 60, 60), (60, 180, 60), (70, 90, 230))  # x forward, y left, z up
_GROUND, _STRUCTURE = (150, 150, 140), (90, 110, 140)  # red, green, blue


class RerunSink(Sink):
    """Map, poses, scans, hypotheses and states for rerun, relative to the map's origin: rerun draws in float32.

    Args:
        save: file to write (``.rrd``); None opens the viewer, which listens on the loopback interface only.

    Raises:
        DependencyError: rerun is not installed. ConfigError: there is no display, or the viewer does not start.
        InputError: the file's directory is missing.
    """

    def __init__(self, save: Path | None = None) -> None:
        self._rerun: Any = require_library("rerun", "rerun-sdk>=0.20", "--rerun")
        self._stream = self._rerun.RecordingStream("coview_stream")
        self._origin: Floats | None = None
        self._ways: dict[str, list[list[float]]] = {}
        self._pieces: dict[str, int] = {}
        self._states: dict[str, str] = {}
        if save is not None:
            if not save.absolute().parent.is_dir():
                raise InputError(f"{save}: there is no such directory; make it first")
            self._stream.save(save)
        else:
            self._stream.connect_grpc(f"rerun+http://{_HOST}:{_start_viewer()}/proxy")
        self._log("map", self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def map(self, view: MapView) -> None:
        """Draw the map."""
        self._origin = view.origin
        colours = np.where(view.is_ground[:, None], _GROUND, _STRUCTURE).astype(np.uint8)
        self._log("map/points", self._rerun.Points3D(view.points, colors=colours, radii=0.05), static=True)

    def pose(self, pose: PoseMessage) -> None:
        """Draw a pose, the path to it and its uncertainty."""
        T, name = self._local(pose.T_map_body), f"map/robots/{pose.robot}"
        self._at(pose.stamp_ns)
        row = pose_to_tum(T)
        turn = self._rerun.Quaternion(xyzw=row[3:])
        self._log(f"{name}/body", self._rerun.Transform3D(translation=row[:3], rotation=turn))
        self._log(f"{name}/body/axes", self._rerun.Arrows3D(vectors=np.eye(3), colors=_AXES))
        spread = pose.covariance[:3, :3]
        if np.isfinite(spread).all():
            half = _SIGMAS * np.sqrt(np.maximum(np.diag(spread), 1e-6))
            self._log(f"{name}/covariance", self._rerun.Ellipsoids3D(half_sizes=[half], centers=[row[:3]]))
        way, piece = self._ways.setdefault(name, []), self._pieces.setdefault(name, 0)
        way.append(row[:3].tolist())
        if len(way) > 1:
            self._log(f"{name}/way/{piece}", self._rerun.LineStrips3D([way]))
        if len(way) >= _STRIP:
            self._ways[name], self._pieces[name] = way[-1:], piece + 1

    def status(self, robot: str, status: dict[str, Any]) -> None:
        """Log a change of state, with its reason."""
        state = str(status.get("state"))[:40]
        if self._states.get(robot) != state:
            self._states[robot] = state
            level = self._rerun.TextLogLevel.INFO if state == "TRACKING" else self._rerun.TextLogLevel.WARN
            text = f"{robot} {state}: {str(status.get('reason'))[:500]}"
            self._log(f"map/robots/{robot}/state", self._rerun.TextLog(text, level=level))

    def hypotheses(self, hypotheses: HypothesesMessage) -> None:
        """Draw the places that a search considers, larger if more probable."""
        if not len(hypotheses.places):
            return
        self._at(hypotheses.stamp_ns)
        places = hypotheses.places[:, :3] - self._zero(hypotheses.places[0, :3])
        sizes = 0.5 + 3.0 * np.clip(hypotheses.places[:, 4], 0.0, 1.0)
        self._log(f"map/robots/{hypotheses.robot}/hypotheses", self._rerun.Points3D(places, radii=sizes))

    def scan(self, scan: Scan) -> None:
        """Draw a scan if its pose is known."""
        if scan.T_map_body is None:
            return
        self._at(scan.stamp_ns)
        points = transform(self._local(scan.T_map_body), scan.points.astype(np.float64))
        self._log(f"map/robots/{scan.robot}/scan", self._rerun.Points3D(points.astype(np.float32), radii=0.04))

    def close(self) -> None:
        """Flush and disconnect."""
        self._stream.flush()
        self._stream.disconnect()

    def _local(self, T: Pose) -> Pose:
        out = T.copy()
        out[:3, 3] -= self._zero(T[:3, 3])
        return out

    def _zero(self, place: Floats) -> Floats:
        """Return the map's origin, or the first place, in whole metres, while the map is unknown."""
        if self._origin is None:
            self._origin = np.asarray(np.round(place), dtype=np.float64)
        return self._origin

    def _at(self, stamp_ns: int) -> None:
        self._stream.set_time("sensor", timestamp=stamp_ns * 1e-9)

    def _log(self, path: str, entity: Any, static: bool = False) -> None:
        self._stream.log(path, entity, static=static)


def _start_viewer() -> int:
    """Start the library's viewer on the loopback interface, and return its port."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError(
            "--rerun: there is no display here; write a file with --record FILE.rrd, and open it elsewhere"
        )
    with socket.socket() as probe:
        probe.bind((_HOST, 0))
        port = int(probe.getsockname()[1])
    folders = (Path(sysconfig.get_path("scripts")), Path(sys.executable).parent)
    viewer = next(
        (folder / name for folder in folders for name in ("rerun", "rerun.exe") if (folder / name).exists()), None
    )
    if viewer is None:
        remedy = f"{PIP_INSTALL} --force-reinstall 'rerun-sdk>=0.20'"
        raise DependencyError(f"--rerun: its viewer is not installed; {remedy}")
    command, nothing = [str(viewer), "--bind", _HOST, "--port", str(port)], subprocess.DEVNULL
    # in its own session it outlives this process
    process = subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing, start_new_session=True)
    deadline = time.monotonic() + _MAX_START
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise ConfigError(
                f"--rerun: the viewer ended with code {process.returncode}; --record FILE.rrd does without"
            )
        with socket.socket() as probe:
            if probe.connect_ex((_HOST, port)) == 0:
                return port
        time.sleep(0.1)
    process.terminate()
    raise ConfigError(f"--rerun: the viewer did not start within {_MAX_START:g} s; --record FILE.rrd does without")
