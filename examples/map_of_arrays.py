"""A map from points in memory, as from a database or another program, with a reference system.

coview-stream demo && python examples/map_of_arrays.py coview-demo/world site.coview
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from coview_stream import BaseMap, read_cloud


def main(world: Path, site: Path) -> BaseMap:
    """Write the map and return it as it is read back."""
    cloud = read_cloud(world / "base.laz")
    # float64, as float32 is decimetres off at UTM coordinates. Several arrays, or arrays and files, also give one map.
    points = np.add(cloud.map_points(), [500_000.0, 5_400_000.0, 0.0])
    base_map = BaseMap.build(points, crs="EPSG:25832", learned=False)
    print(base_map.summary)  # extent, area, density, heights: the line to check
    for warning in base_map.summary.warnings:
        print(f"warning: {warning}")
    base_map.save(site)
    loaded = BaseMap.load(site)
    print(f"{loaded}; points from {loaded.bounds[0].round(1)} to {loaded.bounds[1].round(1)}")
    return loaded


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
