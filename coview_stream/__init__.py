"""Lidar localization of robots on a base map, without GPU, GNSS, ROS or an initial guess.

>>> from coview_stream import BaseMap, Localizer
>>> localizer = Localizer(BaseMap.load("site.coview"))      # doctest: +SKIP
>>> fix = localizer.step(cloud, T_odom_body, stamp)          # doctest: +SKIP

Maps: :class:`BaseMap`, :class:`MapConfig`, :func:`fetch_map`, :func:`read_cloud`. Localization: :class:`Localizer`,
:class:`AsyncLocalizer`, :class:`LocalizerConfig`, :class:`Fix`, :func:`open_run` for recorded runs. Client of a node:
:class:`RobotClient`, :class:`PoseMessage`. Errors: :class:`CoViewError` and its subclasses.

Names are loaded on first use: importing the package costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module as _import_module
from typing import TYPE_CHECKING
from typing import Any as _Any

from coview_stream.errors import naming_missing_libraries as _naming_missing_libraries
from coview_stream.version import __version__

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.basemap.summary import MapSummary
    from coview_stream.clouds.files import read_cloud
    from coview_stream.config import AcceptanceConfig, LocalizerConfig, MapConfig
    from coview_stream.errors import (
        CloudError,
        ConfigError,
        CoViewError,
        CoViewWarning,
        DependencyError,
        InputError,
        MapError,
        RunError,
        TransportError,
    )
    from coview_stream.geometry.protection import ProtectionLevel
    from coview_stream.localization.localizer import Localizer
    from coview_stream.localization.result import Fix, KeyframeEvidence
    from coview_stream.localization.search.hints import PlaceGuess
    from coview_stream.localization.state import State
    from coview_stream.localization.tracking.monitor import RejectionReason
    from coview_stream.messages.types import PoseMessage
    from coview_stream.recordings.open_run import open_run
    from coview_stream.recordings.run import Run
    from coview_stream.stream.async_localizer import AsyncLocalizer
    from coview_stream.stream.client.client import RobotClient
    from coview_stream.stream.maps.fetch_map import fetch_map

__all__ = [
    "AcceptanceConfig",
    "AsyncLocalizer",
    "BaseMap",
    "CloudError",
    "CoViewError",
    "CoViewWarning",
    "ConfigError",
    "DependencyError",
    "Fix",
    "InputError",
    "KeyframeEvidence",
    "Localizer",
    "LocalizerConfig",
    "MapConfig",
    "MapError",
    "MapSummary",
    "PlaceGuess",
    "PoseMessage",
    "ProtectionLevel",
    "RejectionReason",
    "RobotClient",
    "Run",
    "RunError",
    "State",
    "TransportError",
    "__version__",
    "fetch_map",
    "open_run",
    "read_cloud",
]

_NAMES = {
    "basemap.basemap": ("BaseMap",),
    "basemap.summary": ("MapSummary",),
    "clouds.files": ("read_cloud",),
    "config": ("AcceptanceConfig", "LocalizerConfig", "MapConfig"),
    "errors": tuple(name for name in __all__ if name.endswith(("Error", "Warning"))),
    "geometry.protection": ("ProtectionLevel",),
    "localization.localizer": ("Localizer",),
    "localization.result": ("Fix", "KeyframeEvidence"),
    "localization.search.hints": ("PlaceGuess",),
    "localization.state": ("State",),
    "localization.tracking.monitor": ("RejectionReason",),
    "messages.types": ("PoseMessage",),
    "recordings.open_run": ("open_run",),
    "recordings.run": ("Run",),
    "stream.async_localizer": ("AsyncLocalizer",),
    "stream.client.client": ("RobotClient",),
    "stream.maps.fetch_map": ("fetch_map",),
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> _Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with _naming_missing_libraries(name):
        value = getattr(_import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
