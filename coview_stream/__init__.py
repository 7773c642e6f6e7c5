"""Where is the robot on the map? Lidar localization on a base map without GPU, GNSS, ROS or an initial guess.

>>> from coview_stream import BaseMap, Localizer
>>> localizer = Localizer(BaseMap.load("site.coview"))      # doctest: +SKIP
>>> fix = localizer.step(cloud, T_odom_body, stamp)          # doctest: +SKIP
"""

from __future__ import annotations

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig, MapConfig
from coview_stream.errors import CoViewError
from coview_stream.fix import Fix, State
from coview_stream.localizer import Localizer

__all__ = ["BaseMap", "CoViewError", "Fix", "Localizer", "LocalizerConfig", "MapConfig", "State", "__version__"]

__version__ = "0.1.0"
