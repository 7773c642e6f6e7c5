"""Drives whose truth is taken for what was localized."""

import numpy as np
import small_world

from coview_stream.clouds.trajectory import read_tum, write_tum
from coview_stream.fusion.localized_run import LocalizedRun, parse_pair
from coview_stream.recordings.open_run import open_run


def opened(path, mount):
    return open_run(path, mount=mount)


def localized(base_map, folder, drive, off=0.0):
    """Write a drive and its truth, shifted by ``off`` (K, 3) metres, and open both."""
    path = small_world.write_run(folder / "run", drive, len(drive.clouds))
    poses = np.array(drive.T_map_body)
    poses[:, :3, 3] += off
    write_tum(folder / "trajectory.tum", read_tum(path / "odometry.tum")[0], poses)
    return LocalizedRun(parse_pair(f"{path}:{folder}"), base_map, opened)
