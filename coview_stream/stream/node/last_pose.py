"""The last known pose of a robot on a map, on disk: what the next start tries first, and never trusts."""

# FOLDED coview_stream/stream/node/last_pose.py: """Where a robot was last known to be, and whether its engine has yet to hear of it; its session holds the lock."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.errors import ConfigError
from coview_stream.geometry.transforms import Pose, is_pose

log = logging.getLogger(__name__)

VERSION = 1

_FORMAT = "coview_stream last pose"

_LARGEST = 65_536  # bytes; what we write has 500

_LONGEST_NAME = 60


@dataclass(frozen=True)
class LastPose:
    """Where a robot was when it was last known.

    Attributes:
        robot: its name.
        map_sha256: of the base map, 64 hexadecimal digits.
        stamp_ns: sensor time, nanoseconds.
        T_map_body: (4, 4) float64 in the frame of the map's sources, metres.
    """

    robot: str
    map_sha256: str
    stamp_ns: int
    T_map_body: Pose


def save(folder: Path, last: LastPose) -> Path:
    """Write ``last`` for its robot and map, and return the file; what was there before stays whole until it is done.

    Raises:
        OSError: the directory cannot be made or written.
    """
    path = file_of(folder, last.robot, last.map_sha256)
    document = {
        "format": _FORMAT,
        "version": VERSION,
        "robot": last.robot,
        "map_sha256": last.map_sha256,
        "stamp_ns": int(last.stamp_ns),
        "T_map_body": np.asarray(last.T_map_body, dtype=np.float64).tolist(),
    }
    folder.mkdir(parents=True, exist_ok=True)
    # a robot's day usually ends with a power cut: synced, and one name for all, so that at most one is left behind
    with atomic_file(path, sync=True, temporary=path.with_suffix(".part")) as file:
        file.write(json.dumps(document, indent=1).encode())
    return path


def try_out(folder: Path) -> None:
    """Make a directory if it is not there, write a file into it and delete that.

    Raises:
        OSError: one of these cannot be done.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".try-") as file:
        file.write(b"x")


def load(folder: Path, robot: str, map_sha256: str) -> LastPose | None:
    """Read what was saved for a robot and a map.

    Returns:
        None if there is nothing, and, after a warning that names the file, if it cannot be used: it is damaged, of
        another version, or not of this robot and map.
    """
    path = file_of(folder, robot, map_sha256)
    try:
        with path.open("rb") as file:
            last = _parsed(file.read(_LARGEST + 1))
        if (last.robot, last.map_sha256) != (robot, map_sha256):
            raise ValueError("it is of another robot or map")
    except FileNotFoundError:
        return None
    except OSError as error:
        log.warning("%s: the last pose cannot be read (%s); searching without", path, error.strerror or error)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        log.warning("%s: is no last pose to be used (%s); searching without", path, error)
    else:
        return last
    return None


def forget(folder: Path, robot: str, map_sha256: str) -> None:
    """Delete what was saved for a robot and a map, if anything; OSError if that cannot be done."""
    file_of(folder, robot, map_sha256).unlink(missing_ok=True)


def file_of(folder: Path, robot: str, map_sha256: str) -> Path:
    """Return where the pose of a robot on a map is kept: its name, made safe for every file system, and 16 digits."""
    name = quote(robot, safe="")
    if name != robot.lower() or len(name) > _LONGEST_NAME:  # 'R1' and 'r1' are one file on some systems
        name = f"{name[:_LONGEST_NAME]}-{hashlib.sha256(robot.encode()).hexdigest()[:8]}"
    return folder / f"{name}-{map_sha256[:16]}.json"


def default_folder() -> Path:
    """Return where programs of this user keep what they know from one run to the next.

    Raises:
        ConfigError: the user has no home directory.
    """
    if sys.platform == "win32":
        place = os.environ.get("LOCALAPPDATA", "")
        behind_home = "AppData/Local"
    else:
        place = os.environ.get("XDG_STATE_HOME", "")
        behind_home = ".local/state"
    try:
        # the specification says that a relative one is to be ignored
        root = Path(place) if place and Path(place).is_absolute() else Path.home() / behind_home
    except RuntimeError as error:
        raise ConfigError(
            f"cannot tell where to keep the last poses ({error}); use --state DIR or --no-state"
        ) from error
    return root / "coview-stream"


def _parsed(data: bytes) -> LastPose:
    """ValueError, TypeError, KeyError, OverflowError or RecursionError if it is not what :func:`save` writes."""
    if len(data) > _LARGEST:
        raise ValueError(f"longer than {_LARGEST} bytes")
    document: Any = json.loads(data.decode("utf-8"))
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise ValueError("it is something else")
    if document.get("version") != VERSION:
        raise ValueError(f"version {document.get('version')!r:.20}, this release reads {VERSION}")
    T = np.asarray(document["T_map_body"], dtype=np.float64)
    if not is_pose(T):
        raise ValueError("T_map_body is not a finite rigid 4x4 transform")
    return LastPose(str(document["robot"]), str(document["map_sha256"]), int(document["stamp_ns"]), T)


@dataclass(frozen=True)
class LastKnownPose:
    """What a session knows of a robot's place, to be kept for the next start.

    Attributes:
        forgotten: how often somebody has asked to forget it.
        stamp_ns: sensor time, nanoseconds; None unless the robot is being tracked.
        T_map_body: (4, 4) in the frame of the map's sources; None likewise.
    """

    forgotten: int
    stamp_ns: int | None = None
    T_map_body: Pose | None = None


class PoseHint:
    """A place that is suggested to the engine once in every odometry frame, until somebody asks to forget it.

    The engine treats it as a hypothesis (:meth:`coview_stream.localization.localizer.Localizer.suggest`).

    Attributes:
        forgotten: how often somebody has asked.
    """

    def __init__(self) -> None:
        self.forgotten = 0
        self._place: Pose | None = None
        self._owed = False

    @property
    def due(self) -> Pose | None:
        """What goes with the next frame, if anything: ``T_map_body`` (4, 4)."""
        return self._place if self._owed else None

    def seen(self, T_map_body: Pose) -> None:
        """Take note of a verified place, which the engine knows of course."""
        self._place, self._owed = T_map_body, False

    def suggest(self, T_map_body: Pose) -> None:
        """Take note of a place from before this session."""
        self._place, self._owed = T_map_body, True

    def begin_anew(self) -> None:
        """Owe the place again: the engine forgets all with the odometry frame, but the robot stands where it stood."""
        self._owed = self._place is not None

    def told(self, suggested: Pose | None) -> None:
        """Take note of what the engine has heard of with a frame, if anything."""
        if suggested is self._place:
            self._owed = False

    def drop(self) -> None:
        """Never suggest this place again; only a new one."""
        self._place, self._owed = None, False

    def forget(self) -> None:
        """Do so because somebody asks, and what is kept for the next start is to go as well."""
        self.drop()
        self.forgotten += 1
