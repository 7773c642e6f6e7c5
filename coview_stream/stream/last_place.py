"""Where a robot was last known to be, and whether its engine has yet to hear of it; its session holds the lock."""

from __future__ import annotations

from dataclasses import dataclass

from coview_stream.geometry import Pose


@dataclass(frozen=True)
class Recollection:
    """What a session knows of a robot's place, to be kept for the next start.

    Attributes:
        forgotten: how often somebody has asked to forget it.
        stamp_ns: sensor time, nanoseconds; None unless the robot is being tracked.
        T_map_body: (4, 4) in the frame of the map's sources; None likewise.
    """

    forgotten: int
    stamp_ns: int | None = None
    T_map_body: Pose | None = None


class LastPlace:
    """A place that is suggested to the engine once in every odometry frame, until somebody asks to forget it.

    The engine treats it as a hypothesis (:meth:`coview_stream.localizer.Localizer.suggest`).

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
