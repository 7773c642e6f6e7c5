"""Lidar localization of robots on a base map, without GPU, GNSS, ROS or an initial guess.

>>> from coview_stream import BaseMap, Localizer
>>> localizer = Localizer(BaseMap.load("site.coview"))      # doctest: +SKIP
>>> fix = localizer.step(cloud, T_odom_body, stamp)          # doctest: +SKIP

Names are loaded when they are first used: importing the package costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from coview_stream.errors import naming_missing_libraries
from coview_stream.version import __version__

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.config import LocalizerConfig, MapConfig
    from coview_stream.errors import CoViewError
    from coview_stream.geometry.protection import ProtectionLevel
    from coview_stream.localization.localizer import Localizer
    from coview_stream.localization.result import Fix, KeyframeEvidence
    from coview_stream.localization.state import State
    from coview_stream.localization.tracking.monitor import RejectionReason
    from coview_stream.stream.client.client import RobotClient

__all__ = [
    "BaseMap",
    "CoViewError",
    "Fix",
    "KeyframeEvidence",
    "Localizer",
    "LocalizerConfig",
    "MapConfig",
    "ProtectionLevel",
    "RejectionReason",
    "RobotClient",
    "State",
    "__version__",
]

_HOMES = {
    "BaseMap": "basemap.basemap",
    "CoViewError": "errors",
    "Fix": "localization.result",
    "KeyframeEvidence": "localization.result",
    "Localizer": "localization.localizer",
    "LocalizerConfig": "config",
    "MapConfig": "config",
    "ProtectionLevel": "geometry.protection",
    "RejectionReason": "localization.tracking.monitor",
    "RobotClient": "stream.client.client",
    "State": "localization.state",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with naming_missing_libraries(name):
        value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
