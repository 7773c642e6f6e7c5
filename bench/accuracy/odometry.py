"""Lidar odometry of whole runs against the truth: how much roll and pitch shake, and whether the frame stays level.

Each folder of ``--runs`` holds ``run/`` (frames and stamps) and ``truth.tum``. Its clouds go through *KISS-ICP* as it
is, and through *ours*, which keeps level. Needs kiss-icp. Steps are compared from frame to frame, in the body's axes;
the lean is between the z axes of the odometry frame and of the truth, which may lean against gravity itself.
"""

from __future__ import annotations

import contextlib
import itertools
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bench.harness.rows import Row, informs, listed
from coview_stream.clouds import read_tum
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import CloudError, InputError
from coview_stream.geometry.transforms import Poses, inverse, log_so3
from coview_stream.odometry.lidar_odometry import KissRegistration, LidarOdometry
from coview_stream.recordings.lidar_runs import open_bare_run
from coview_stream.recordings.run import Run

_NEAR = 0.05  # seconds between a frame and its truth


def options(parser: ArgumentParser) -> None:
    """Add the runs."""
    parser.add_argument("--runs", nargs="+", type=Path, default=[], metavar="DIR", help="each with run/ and truth.tum")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per run and odometry."""
    if not asked.runs:
        raise InputError("no runs: give --runs DIR ..., each with run/ and truth.tum")
    for folder in asked.runs:
        run = open_bare_run(folder / "run")
        stamps, truth = read_tum(folder / "truth.tum")
        for name, odometry in (("KISS-ICP", plain), ("ours", ours)):
            frames, poses = odometry(run)
            nearest = np.abs(run.stamps[frames][:, None] - stamps).argmin(axis=1)
            known = np.abs(stamps[nearest] - run.stamps[frames]) < _NEAR
            scores = scored(poses[known], truth[nearest[known]])
            details = {"run": folder.name, "odometry": name, "frames": len(poses), **scores}
            yield informs(f"odometry/{folder.name}, {name}: tilt per step", scores["tilt"], "deg", details)


def plain(run: Run) -> tuple[list[int], Poses]:
    """KISS-ICP with its own prediction, from a level start; the frames, and their poses (N, 4, 4)."""
    icp = KissRegistration(LidarOdometryConfig())
    poses = [np.eye(4)]
    for k in range(len(run)):
        step = inverse(poses[-2]) @ poses[-1] if k > 1 else np.eye(4)
        poses.append(icp.register(run.read(k).points.astype(np.float64), poses[-1] @ step))
    return list(range(len(run))), np.array(poses[1:])


def ours(run: Run) -> tuple[list[int], Poses]:
    """Step the product's odometry; the frames that it took, and their poses (N, 4, 4)."""
    odometry, frames, poses = LidarOdometry(LidarOdometryConfig()), [], []
    for k in range(len(run)):
        frame = run.read(k)
        with contextlib.suppress(CloudError):
            poses.append(odometry.step(frame.points, None, frame.stamp))
            frames.append(k)
    return frames, np.array(poses)


def scored(poses: Poses, truth: Poses) -> dict[str, float]:
    """Compare odometry with the truth, both (N, 4, 4), in frames of their own.

    Degrees: root mean square of roll and pitch per step, and the mean lean.
    """
    made, real = ([inverse(T) @ after for T, after in itertools.pairwise(part)] for part in (poses, truth))
    turned = np.degrees([log_so3(b[:3, :3].T @ a[:3, :3]) for a, b in zip(made, real, strict=True)])
    sine = np.linalg.norm(np.cross(poses[:, 2, :3], truth[:, 2, :3]), axis=1)
    lean = np.degrees(np.arctan2(sine, (poses[:, 2, :3] * truth[:, 2, :3]).sum(axis=1)))
    return {"tilt": float(np.sqrt((turned[:, :2] ** 2).mean())), "lean": float(lean.mean())}


COLUMNS = (
    ("run", "run", None), ("odometry", "odometry", None), ("frames", "frames", 0), ("roll, pitch deg", "tilt", 3),
    ("lean deg", "lean", 2),
)  # fmt: skip


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """All runs."""
    return {"": listed(COLUMNS, [row.details for row in rows])}
