"""Comparison of the descriptor channels that may vote, each on its own, with the truth.

    coview-stream demo && python examples/custom_descriptor.py coview-demo/world

Then give the good ones to the map: `coview-stream build ... --channels scan_context,coview`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import get_args

import numpy as np

from coview_stream import BaseMap
from coview_stream.clouds import read_tum
from coview_stream.config import Channel, KeyframeConfig
from coview_stream.descriptors.coview import describe, ground_below
from coview_stream.localization.calibration.calibration import RawScan
from coview_stream.localization.registration.clouds import voxelized
from coview_stream.localization.search.keyframes import KeyframeBuffer
from coview_stream.localization.search.retrieval import exact_distances
from coview_stream.recordings import open_run

NEAR = 3.0  # metres: the station found counts as right


def main(world: Path) -> dict[str, float]:
    """Print and return, by channel, the share of keyframes whose most similar station is the right one."""
    base_map = BaseMap.build(world / "base.laz", channels=get_args(Channel))
    keyframes = KeyframeBuffer(KeyframeConfig())
    settings = base_map.descriptor_config
    stations = base_map.stations + base_map.origin
    _, truth = read_tum(world / "truth.tum")

    found: dict[str, list[bool]] = {name: [] for name in settings.channels}
    for frame in open_run(world / "run"):
        points = voxelized(frame.points, frame.T_odom_body, keyframes.config)
        keyframe = keyframes.add(RawScan(points, frame.T_odom_body), frame.stamp)
        if keyframe is None:
            continue
        scan = keyframes.virtual_scan(keyframe.position, settings.radius, settings.voxel)
        centre = keyframe.position.copy()
        centre[2] = ground_below(scan, keyframe.position)  # both sides measure heights from the ground
        for channel, query in describe(scan, centre, settings).items():
            distance = exact_distances(base_map.descriptors(channel), query)
            station = stations[distance.min(axis=1).argmin()]  # (stations, shifts): the smallest over all shifts
            miss = np.linalg.norm(station[:2] - truth[frame.index, :2, 3])
            found[channel].append(bool(miss < NEAR))
    shares = {name: float(np.mean(right)) for name, right in found.items()}
    for name, share in shares.items():
        print(f"{name:<14} right at {share:.0%} of {len(found[name])} keyframes")
    return shares


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "coview-demo/world"))
