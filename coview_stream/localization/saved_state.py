"""State of a localizer in a file, for programs that restart on a robot that has not moved."""

from __future__ import annotations

import contextlib
import json
import os
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import Pose, is_pose
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.result import Fix

_FORMAT, _VERSION = "coview_stream state", 1
_MAX_BYTES = 65_536  # a saved state has a thousand


class _Localizer(Protocol):
    @property
    def calibration(self) -> Calibration: ...

    def fix(self) -> Fix: ...

    def hint_pose(self, T_map_body: Pose) -> None: ...

    def hint_calibration(self, earlier: Calibration) -> None: ...


class SavedState:
    """Mixin of localizers: the newest pose and the calibration, in a file."""

    def save_state(self: _Localizer, path: str | os.PathLike[str]) -> None:
        """Write the pose of the newest frame and the calibration, as JSON, complete or not at all.

        Without a pose, the pose already in the file stays; before the first frame, the whole file stays. Call it after
        frames, as often as you like, to lose little in a crash or power cut. OSError if the file cannot be written.
        """
        path = Path(path)
        try:
            T_map_body = self.fix().T_map_body
        except RuntimeError:  # no frame yet
            if path.exists():
                return
            T_map_body = None
        if T_map_body is None and path.exists():
            with contextlib.suppress(InputError):
                T_map_body = _read(path)[0]
        document = {
            "format": _FORMAT,
            "version": _VERSION,
            "T_map_body": None if T_map_body is None else T_map_body.tolist(),
            "calibration": asdict(self.calibration),  # radians and metres
        }
        with atomic_file(path, sync=True) as file:
            file.write(json.dumps(document, indent=1).encode())

    def load_state(self: _Localizer, path: str | os.PathLike[str]) -> bool:
        """Start from the file of :meth:`save_state`, before the first frame. False if there is no file.

        The pose is a hint, which the search judges like any other place (:meth:`Localizer.hint_pose`): the robot may
        have been carried. InputError if the file is damaged, of another version, or of another kind.
        """
        path = Path(path)
        if not path.exists():
            return False
        T_map_body, calibration = _read(path)
        if T_map_body is not None:
            self.hint_pose(T_map_body)
        if calibration is not None:
            self.hint_calibration(calibration)
        return True


def _read(path: Path) -> tuple[Pose | None, Calibration | None]:
    try:
        with path.open("rb") as file:
            document = read_document(file.read(_MAX_BYTES), _FORMAT, _VERSION)
        pose = None if document["T_map_body"] is None else read_pose(document, "T_map_body")
        return pose, read_calibration(document["calibration"])
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError, OSError) as error:
        raise InputError(f"{path}: holds no state that can be used ({error}); delete it to begin without") from error


def read_document(data: bytes, form: str, version: int) -> dict[str, Any]:
    """Return a JSON document of a format and version; ValueError or RecursionError if it is damaged or differs."""
    document: Any = json.loads(data)
    if not isinstance(document, dict) or document.get("format") != form:
        raise ValueError("it is something else")
    if document.get("version") != version:
        raise ValueError(f"version {document.get('version')!r:.20}, this release reads {version}")
    return document


def read_pose(document: Any, name: str) -> Pose:
    """Return a transform (4, 4) from plain data; ValueError, TypeError or KeyError if it is not one."""
    T = np.asarray(document[name], dtype=np.float64)
    if not is_pose(T):
        raise ValueError(f"{name} is not a finite rigid 4x4 transform")
    return T


def read_calibration(plain: Any) -> Calibration | None:
    """Return a calibration from plain data, None from None; ValueError, TypeError or InputError if it is not one."""
    if plain is None:
        return None
    if not isinstance(plain, dict):
        raise ValueError("its calibration is something else")
    names = {f.name for f in fields(Calibration)}
    return Calibration(**{name: float(value) for name, value in plain.items() if name in names}).require_plausible()
