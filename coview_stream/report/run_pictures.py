"""Pictures of a localized run: the trajectory on the map, and the descriptors that matched first."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.geometry.arrays import Reals
from coview_stream.localization.offline import DESCRIPTORS_PNG, TRAJECTORY_PNG, RunResult
from coview_stream.report.plots import plot_descriptor_pair, plot_trajectory
from coview_stream.report.style import MAX_BASE_POINTS


def draw_run(result: RunResult, base_map: BaseMap, folder: Path, truth: Reals | None = None) -> None:
    """Draw ``trajectory.png`` and, after a fix, ``descriptors.png`` into an existing folder.

    ``truth`` are true positions (T, 3) in the map, metres, drawn beside the estimate.

    Raises:
        InputError: a picture cannot be written.
    """
    no_position = np.full(3, np.nan)
    positions = np.array([no_position if f.T_map_body is None else f.T_map_body[:3, 3] for f in result.fixes])
    base_map.release()  # of what searching took, before pictures take as much
    points = base_map.sampled_points(MAX_BASE_POINTS) + base_map.origin
    base_map.release()
    states = [fix.state.reported for fix in result.fixes]
    plot_trajectory(points, positions, states, folder / TRAJECTORY_PNG, truth)
    winner = result.winner
    if winner is not None and winner.station is not None and winner.shift is not None and result.query:
        channel = next(iter(result.query))
        station = base_map.descriptors_of(winner.station)[channel].astype(np.float32)
        titles = (f"keyframe ({channel})", f"winning station {winner.station}")
        plot_descriptor_pair(result.query[channel], station, winner.shift, folder / DESCRIPTORS_PNG, titles)
