"""Last place of a robot: its file, its message to another node, and user guesses.

Each is a hypothesis, which the engine verifies like any other
(:meth:`coview_stream.localization.localizer.Localizer.hint_pose`).
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import stat
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import numpy as np

from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.errors import ConfigError, InputError, MessageError
from coview_stream.geometry.transforms import Pose, yaw_of
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.saved_state import read_calibration, read_document, read_pose
from coview_stream.localization.search.hints import MAX_DISTANCE, PlaceGuess
from coview_stream.messages import decode_pose
from coview_stream.messages.json_messages import read_object
from coview_stream.messages.types import Sample

log = logging.getLogger(__name__)

VERSION = 1  # of the file's format

_FORMAT = "coview_stream last pose"
_MAX_BYTES = 65_536  # of a file; ours have about 500
_MAX_NAME = 60  # characters of a robot's name in its file's name
_MAX_GUESS_BYTES = 4096
_SIGMAS = 2.0  # range tried around a suggested pose, in standard deviations of its covariance
_GUESS_FIELDS = ("x", "y", "yaw", "distance", "angle", "map", "within")


@dataclass(frozen=True, eq=False)
class LastPlace:
    """A robot's place on a map. Files hold its ``T_map_body``, messages between nodes its ``T_map_odom``."""

    map_sha256: str  # of the base map, 64 hexadecimal digits; for a site, that of its state
    stamp_ns: int | None = None  # sensor time of ``T_map_body``, nanoseconds
    T_map_body: Pose | None = None  # (4, 4) float64 in the frame of the map's sources, metres
    T_map_odom: Pose | None = None  # (4, 4) map <- odometry; odometry continues when another node takes over
    calibration: Calibration | None = None  # of sensor and odometry; None if unknown

    def to_message(self) -> dict[str, Any]:
        """Return the plain data for a message to another node."""
        plain: dict[str, Any] = {"map_sha256": self.map_sha256, "T_map_odom": np.asarray(self.T_map_odom).tolist()}
        return plain if self.calibration is None else plain | {"calibration": asdict(self.calibration)}

    @classmethod
    def from_message(cls, plain: Any) -> LastPlace:
        """Read :meth:`to_message`, from anyone; ValueError, TypeError or KeyError if it is something else."""
        return cls(
            map_sha256=str(plain["map_sha256"])[:64],
            T_map_odom=read_pose(plain, "T_map_odom"),
            calibration=read_calibration(plain.get("calibration")),
        )


# ---- files


def save(folder: Path, robot: str, place: LastPlace) -> Path:
    """Write a robot's place and return the file; OSError if the directory cannot be created or written.

    Only the owner may read the file. A robot's day usually ends with a power cut, so the bytes are on the disk before
    the file gets its name.
    """
    path = file_of(folder, robot, place.map_sha256)
    document = {
        "format": _FORMAT,
        "version": VERSION,
        "robot": robot,
        "map_sha256": place.map_sha256,
        "stamp_ns": int(place.stamp_ns or 0),
        "T_map_body": np.asarray(place.T_map_body, dtype=np.float64).tolist(),
    }
    if place.calibration is not None:
        document["calibration"] = asdict(place.calibration)  # radians and metres
    _make(folder)
    with atomic_file(path, sync=True, private=True) as file:  # replaces a link instead of following it
        file.write(json.dumps(document, indent=1).encode())
    return path


def load(folder: Path, robot: str, map_sha256: str) -> LastPlace | None:
    """Read a robot's file for a map; None if missing or, with a warning, damaged or of other version, robot or map."""
    path = file_of(folder, robot, map_sha256)
    try:
        with _open_regular(path) as file:
            data = file.read(_MAX_BYTES + 1)
        if len(data) > _MAX_BYTES:
            raise ValueError(f"longer than {_MAX_BYTES} bytes")
        document = read_document(data, _FORMAT, VERSION)
        if (str(document["robot"]), str(document["map_sha256"])) != (robot, map_sha256):
            raise ValueError("it is of another robot or map")
        return LastPlace(
            map_sha256,
            stamp_ns=int(document["stamp_ns"]),
            T_map_body=read_pose(document, "T_map_body"),
            calibration=read_calibration(document.get("calibration")),
        )
    except FileNotFoundError:
        return None
    except OSError as error:
        log.warning("%s: the last pose cannot be read (%s); searching without", path, error.strerror or error)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        log.warning("%s: holds no last pose that can be used (%s); searching without", path, error)
    return None


def forget(folder: Path, robot: str, map_sha256: str) -> None:
    """Delete a robot's file for a map, if there is one; OSError if that fails."""
    file_of(folder, robot, map_sha256).unlink(missing_ok=True)


def file_of(folder: Path, robot: str, map_sha256: str) -> Path:
    """Return a robot's file for a map: the robot's name, safe for every file system, and 16 digits of the hash."""
    name = quote(robot, safe="")
    if name != robot.lower() or len(name) > _MAX_NAME:  # 'R1' and 'r1' are one file on some systems
        name = f"{name[:_MAX_NAME]}-{hashlib.sha256(robot.encode()).hexdigest()[:8]}"
    return folder / f"{name}-{map_sha256[:16]}.json"


def try_out(folder: Path) -> None:
    """Create a directory if it is missing, write a file into it and delete the file; OSError if that fails."""
    _make(folder)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".try-") as file:
        file.write(b"x")


def default_folder() -> Path:
    """Return this user's directory for program state between runs; ConfigError without a home directory."""
    folder = Path(os.environ.get("XDG_STATE_HOME", ""))
    if not folder.is_absolute():  # the specification says to ignore a relative one
        try:
            folder = Path.home() / ".local/state"
        except RuntimeError as error:
            raise ConfigError(
                f"cannot tell where to keep the last poses ({error}); use --state DIR or --no-state"
            ) from error
    return folder / "coview-stream"


def _make(folder: Path) -> None:
    """Create a directory that only its owner may enter; an existing one keeps its mode."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)


def _open_regular(path: Path) -> BinaryIO:
    """Open a file for reading; OSError for a link, and for a pipe or device, which could block."""
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    file = os.fdopen(os.open(path, flags), "rb")
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError("it is not a file")
    return file


# ---- user guesses: parameters of a query, JSON, or RViz's pose


def guess_of_fields(given: Mapping[str, Any]) -> PlaceGuess:
    """Return the guess in named numbers or their texts: x and y, perhaps yaw, distance and angle (radians, metres).

    ``map`` names the map in whose frame they are; a lone map is called ``map``. ``within``: as in :class:`PlaceGuess`.
    InputError if x or y is missing, a name is unknown, or a value is not a number or out of range.
    """
    unknown = sorted(set(given) - set(_GUESS_FIELDS))
    if unknown or "x" not in given or "y" not in given:
        problem = f"{unknown[0]!r} is unknown" if unknown else "x or y is missing"
        raise InputError(
            f"initial pose: {problem}; give x, y and perhaps yaw, distance, angle, within (metres, radians)"
        )
    map_name = given.get("map") or None
    if not isinstance(map_name, str | None):
        raise InputError(f"initial pose: map is {str(map_name)[:40]!r}, which is not a name")
    numbers: dict[str, float] = {}
    for name, value in given.items():
        if name == "map" or (value is None and name in ("yaw", "within")):
            continue
        try:
            if isinstance(value, bool):
                raise TypeError("it is a truth value")
            numbers[name] = float(value)
        except (TypeError, ValueError) as error:
            raise InputError(f"initial pose: {name} is {str(value)[:40]!r}, which is not a number") from error
    try:
        return PlaceGuess(**numbers, map=map_name)
    except ConfigError as error:
        raise InputError(f"initial pose: {error}") from error


def decode_guess(sample: Sample) -> PlaceGuess:
    """Read JSON with the fields of :func:`guess_of_fields`, or a PoseWithCovarianceStamped in CDR; else InputError."""
    payload = bytes(sample.payload[: _MAX_GUESS_BYTES + 1])
    if len(payload) > _MAX_GUESS_BYTES:
        raise MessageError(f"{sample.key}: an initial pose of more than {_MAX_GUESS_BYTES} bytes")
    if payload.lstrip().startswith(b"{"):
        return guess_of_fields(read_object(payload))
    pose = decode_pose(sample, "cdr")
    spread = math.sqrt(max(float(np.nanmax(np.diag(pose.covariance)[:2])), 0.0)) if pose.covariance.size else 0.0
    turn = math.sqrt(max(float(np.nan_to_num(pose.covariance[5, 5])), 0.0)) if pose.covariance.size else 0.0
    return guess_of_fields({
        "x": pose.T_map_body[0, 3], "y": pose.T_map_body[1, 3], "yaw": yaw_of(pose.T_map_body),
        "distance": min(max(_SIGMAS * spread, 3.0), MAX_DISTANCE), "angle": min(max(_SIGMAS * turn, 0.3), math.pi),
        "map": pose.frame_id,
    })  # fmt: skip
