"""A run as GeoJSON and CSV with latitude and longitude, for QGIS or a spreadsheet.

coview-stream demo && python examples/trajectory_for_gis.py coview-demo/world out
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from coview_stream import BaseMap, Localizer, State, read_cloud
from coview_stream.clouds.reference_system import GeoReference
from coview_stream.recordings import open_run
from coview_stream.report.export import export, trajectory_of


def main(world: Path, folder: Path) -> list[Path]:
    """Write the files, and return them."""
    # the simulated world has no place on Earth, so it is moved to zone 32
    points = np.add(read_cloud(world / "base.laz").map_points(), [500_000.0, 5_400_000.0, 300.0])
    base_map = BaseMap.build(points, crs="EPSG:25832", learned=False)
    localizer = Localizer(base_map)
    stamps, poses = [], []
    for frame in open_run(world / "run"):
        fix = localizer.step(frame.points, frame.T_odom_body, frame.stamp)
        if fix.state is State.TRACKING:
            stamps.append(fix.stamp)
            poses.append(fix.T_map_body)
    folder.mkdir(exist_ok=True)
    trajectory = trajectory_of("drive", stamps, poses, GeoReference(base_map.crs))
    latitude, longitude, height = trajectory.geodetic[-1]
    print(f"ends at {latitude:.6f}, {longitude:.6f}, {height:.1f} m")
    return export(trajectory, folder, ["geojson", "csv"])


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    print(*main(Path(sys.argv[1]), Path(sys.argv[2])))
