"""Runs whose odometry is missing, or not wanted: frames and stamps, and no poses worth the name."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coview_stream.clouds.layout import find_bag, find_layout, read_stamps
from coview_stream.clouds.runs import Run, of_bag
from coview_stream.clouds.track import Track
from coview_stream.clouds.trajectory import Poses

_PERIOD = 0.1  # seconds between frames that nobody has dated


def open_bare_run(path: Path, cloud_topic: str | None = None) -> Run:
    """Open a run as :func:`~coview_stream.clouds.runs.open_run` does, but for its odometry: all poses are the identity.

    Stamps of frames in files are those of ``times.txt``, of an ``odometry.tum`` that lies there, or else 0.1 s apart.
    Clouds of recordings are not deskewed.

    Raises:
        RunError: no frames, or stamps that do not fit.
    """
    if (bag := find_bag(path)) is not None:
        from coview_stream.clouds.bags import open_bag  # as in open_run: bags build on the live decoders

        return of_bag(bag, open_bag(bag, None, cloud_topic, None, lambda clouds: _nowhere(clouds.stamps)))
    layout = find_layout(path)
    told = read_stamps(layout)
    notes = () if told is not None else (f"{path}: no times.txt; frames are taken for {_PERIOD:g} s apart",)
    stamps = _PERIOD * np.arange(len(layout.frames), dtype=np.float64) if told is None else told
    return Run(path, layout.frames, stamps, _identities(len(stamps)), notes=notes)


def _nowhere(stamps: np.ndarray) -> Track:
    return Track(stamps, _identities(len(stamps)))


def _identities(count: int) -> Poses:
    return np.tile(np.eye(4), (count, 1, 1))
