"""Last known pose of a robot on a map: its file, and the hint that the next start and each new epoch make of it."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import logging
import math
import os
import stat
import sys
import tempfile
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import numpy as np

from coview_stream.errors import ConfigError
from coview_stream.geometry.transforms import Pose, is_pose
from coview_stream.localization.calibration.calibration import Calibration

log = logging.getLogger(__name__)

VERSION = 1

_FORMAT = "coview_stream last pose"
_MAX_BYTES = 65_536  # of a file; what we write has 500; set by hand
_MAX_LEAN = float(np.radians(45.0))  # of a sensor against its mount; set by hand
_MAX_NAME = 60  # characters of a robot's name in that of its file; set by hand


@dataclass(frozen=True)
class LastPose:
    """Pose of a robot on a map, as its file has it.

    Attributes:
        robot: its name.
        map_sha256: of the base map, 64 hexadecimal digits; of a site that of its state, which all parts of it share.
        stamp_ns: sensor time, nanoseconds.
        T_map_body: (4, 4) float64 in the frame of the map's sources, metres.
        calibration: what was corrected of its sensor and odometry there; None if that was not known.
    """

    robot: str
    map_sha256: str
    stamp_ns: int
    T_map_body: Pose
    calibration: Calibration | None = None


def save(folder: Path, last: LastPose) -> Path:
    """Write ``last`` for its robot and map, and return the file; the one before stays whole until then.

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
    if last.calibration is not None:
        document["calibration"] = asdict(last.calibration)  # radians and metres
    _make(folder)
    _write_whole(path, json.dumps(document, indent=1).encode())
    return path


def _make(folder: Path) -> None:
    """Make a directory that only its owner may enter; one that is there keeps its mode."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)


def _write_whole(path: Path, data: bytes) -> None:
    """Write a file that only its owner may read: beside its place under a name that nobody can foresee, then renamed.

    A robot's day usually ends with a power cut: the bytes are on the disk before the name changes. What a cut leaves
    behind is for :func:`remove_parts`, at the next start.
    """
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f"{path.stem}.", suffix=".part")  # 0600, no link followed
    part = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)  # a link in its place is replaced, not followed
    finally:
        part.unlink(missing_ok=True)


def _open_regular(path: Path) -> BinaryIO:
    """Open a file to read; OSError for a link, and for what is no file and could block, such as a pipe."""
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    file = os.fdopen(os.open(path, flags), "rb")
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError("it is no file")
    return file


def remove_parts(folder: Path, robot: str, map_sha256: str) -> None:
    """Delete what writes for a robot and a map that were cut short have left behind; not while one may be under way."""
    path = file_of(folder, robot, map_sha256)
    with contextlib.suppress(OSError):
        for part in path.parent.glob(f"{glob.escape(path.stem)}*.part"):
            part.unlink(missing_ok=True)


def try_out(folder: Path) -> None:
    """Make a directory if it is not there, write a file into it and delete that.

    Raises:
        OSError: one of these cannot be done.
    """
    _make(folder)
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
        with _open_regular(path) as file:
            last = _parsed(file.read(_MAX_BYTES + 1))
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
    """Return the file of a robot's pose on a map: the robot's name, safe for every file system, and 16 digits."""
    name = quote(robot, safe="")
    if name != robot.lower() or len(name) > _MAX_NAME:  # 'R1' and 'r1' are one file on some systems
        name = f"{name[:_MAX_NAME]}-{hashlib.sha256(robot.encode()).hexdigest()[:8]}"
    return folder / f"{name}-{map_sha256[:16]}.json"


def default_folder() -> Path:
    """Return the directory in which programs of this user keep their state from one run to the next.

    Raises:
        ConfigError: the user has no home directory.
    """
    if sys.platform == "win32":
        folder = os.environ.get("LOCALAPPDATA", "")
        below_home = "AppData/Local"
    else:
        folder = os.environ.get("XDG_STATE_HOME", "")
        below_home = ".local/state"
    try:
        # the specification says that a relative one is to be ignored
        root = Path(folder) if folder and Path(folder).is_absolute() else Path.home() / below_home
    except RuntimeError as error:
        raise ConfigError(
            f"cannot tell where to keep the last poses ({error}); use --state DIR or --no-state"
        ) from error
    return root / "coview-stream"


def _parsed(data: bytes) -> LastPose:
    """Parse a file; ValueError, TypeError, KeyError, OverflowError or RecursionError if :func:`save` wrote it not."""
    if len(data) > _MAX_BYTES:
        raise ValueError(f"longer than {_MAX_BYTES} bytes")
    document: Any = json.loads(data.decode("utf-8"))
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise ValueError("it is something else")
    if document.get("version") != VERSION:
        raise ValueError(f"version {document.get('version')!r:.20}, this release reads {VERSION}")
    T = np.asarray(document["T_map_body"], dtype=np.float64)
    if not is_pose(T):
        raise ValueError("T_map_body is not a finite rigid 4x4 transform")
    known = read_calibration(document.get("calibration"))
    return LastPose(str(document["robot"]), str(document["map_sha256"]), int(document["stamp_ns"]), T, known)


def read_calibration(plain: Any) -> Calibration | None:
    """Return a calibration as :func:`save` wrote it; ValueError, TypeError or KeyError for another thing."""
    if plain is None:
        return None
    if not isinstance(plain, dict):
        raise ValueError("its calibration is something else")
    names = {f.name for f in fields(Calibration)}
    known = Calibration(**{name: float(value) for name, value in plain.items() if name in names})
    sigmas = all(0 <= s < 1 for s in (known.sigma_tilt, known.sigma_scale, known.sigma_turn))
    if not (
        sigmas
        and math.hypot(known.roll, known.pitch) < _MAX_LEAN
        and abs(known.scale) + abs(known.turn) < 1
        and abs(known.ground) < 10
    ):
        raise ValueError("its calibration is none of a robot")
    return known


@dataclass(frozen=True)
class LastKnownPose:
    """Pose of a robot as its session knows it, to be kept for the next start.

    Attributes:
        forgotten: how often a client has asked to forget it.
        stamp_ns: sensor time, nanoseconds; None unless the robot is TRACKING.
        T_map_body: (4, 4) in the frame of the map's sources; None likewise.
        calibration: what is corrected of its sensor and odometry; None where that is not known.
    """

    forgotten: int
    stamp_ns: int | None = None
    T_map_body: Pose | None = None
    calibration: Calibration | None = None


class PoseHint:
    """Last known pose as a hint for the engine: once in every odometry epoch, until a client asks to forget it.

    The engine verifies it like any hypothesis (:meth:`coview_stream.localization.localizer.Localizer.hint_pose`). The
    session holds the lock.

    Attributes:
        forgotten: how often a client has asked.
        calibration: what was known of the sensor and odometry there; goes with the pose, as a prior.
    """

    def __init__(self) -> None:
        self.forgotten = 0
        self.calibration: Calibration | None = None
        self._T_map_body: Pose | None = None
        self._pending = False

    @property
    def pending(self) -> Pose | None:
        """``T_map_body`` (4, 4) that goes with the next frame; None if the engine has it already."""
        return self._T_map_body if self._pending else None

    @property
    def known(self) -> Pose | None:
        """``T_map_body`` (4, 4), whether the engine has it or not."""
        return self._T_map_body

    def update(self, T_map_body: Pose, calibration: Calibration | None = None) -> None:
        """Take over a pose that the engine itself has verified."""
        self._T_map_body, self.calibration, self._pending = T_map_body, calibration, False

    def offer(self, T_map_body: Pose, calibration: Calibration | None = None) -> None:
        """Take over a pose from before this session, which the engine does not know."""
        self._T_map_body, self.calibration, self._pending = T_map_body, calibration, True

    def begin_epoch(self) -> None:
        """Offer the pose again: the engine forgets all with an odometry frame, but the robot stands where it stood."""
        self._pending = self._T_map_body is not None

    def delivered(self, hint: Pose | None) -> None:
        """Offer the pose no more if it is the one that went with a frame."""
        if hint is self._T_map_body:
            self._pending = False

    def drop(self) -> None:
        """Never offer this pose again; only a new one."""
        self._T_map_body, self.calibration, self._pending = None, None, False

    def forget(self) -> None:
        """Drop the pose because a client asks; the file for the next start is to go as well."""
        self.drop()
        self.forgotten += 1
