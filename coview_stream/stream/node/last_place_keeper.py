"""Keeper of the robots' last places: files, written on its own thread, as a disk may hang."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coview_stream.geometry.transforms import Pose, inverse, rotation_angle
from coview_stream.stream.node.last_place import forget, load, save
from coview_stream.stream.node.session import Session
from coview_stream.stream.transport.error_guard import RateLimitedErrors

log = logging.getLogger("coview_stream.node")

_INTERVAL = 5.0  # seconds between rounds
_MIN_MOVE = 0.1  # metres: a standing robot must not wear out its memory card
_MIN_TURN = float(np.radians(1.0))


class LastPlaceKeeper:
    """Offers every robot its last place at the start, and writes its place every ``interval`` seconds."""

    def __init__(self, folder: Path, sessions: Sequence[Session], interval: float = _INTERVAL) -> None:
        self.folder = folder
        self._sessions = sessions
        self._interval = interval
        self._errors = RateLimitedErrors(log)
        self._written: dict[tuple[str, str], Pose] = {}  # by robot and map
        self._forgotten: dict[str, int] = {}
        self._failing = False

    def run(self, stopping: threading.Event) -> None:
        """Offer the last places, write until ``stopping`` is set, and once more."""
        self.hint()
        while not stopping.wait(self._interval):
            self.keep()
        self.keep()

    def hint(self) -> None:
        """Offer every session the place in its file."""
        for session in self._sessions:
            robot = session.keys.robot
            with self._errors.catch(f"{robot}: its last pose"):
                last = load(self.folder, robot, session.site_sha256)
                if last is not None and last.T_map_body is not None:
                    x, y = last.T_map_body[:2, 3]
                    log.info("%s: was last at %.1f, %.1f on this map: tried first, as a hypothesis", robot, x, y)
                    session.offer(last)

    def keep(self) -> None:
        """Write the place of each robot that is TRACKING; delete files that a client has asked to forget."""
        for session in self._sessions:
            with self._errors.catch(f"{session.keys.robot}: its last pose"):
                self._keep(session)

    def _keep(self, session: Session) -> None:
        robot, sha256 = session.keys.robot, session.site_sha256
        with session.lock:
            place, forgotten = session.last_place(), session.hints.forgotten
        try:
            if forgotten != self._forgotten.get(robot, 0):
                forget(self.folder, robot, sha256)
                self._forgotten[robot] = forgotten
                self._written.pop((robot, sha256), None)
            if place is None or place.T_map_body is None:
                return
            if (written := self._written.get((robot, sha256))) is not None:
                moved = inverse(written) @ place.T_map_body
                if float(np.linalg.norm(moved[:3, 3])) < _MIN_MOVE and rotation_angle(moved) < _MIN_TURN:
                    return
            save(self.folder, robot, place)
            self._written[robot, sha256] = place.T_map_body
        except OSError as error:
            if not self._failing:
                log.warning("%s: cannot keep the last poses (%s); going on without", self.folder, error)
            self._failing = True
        else:
            self._failing = False
