"""Lidar odometry of whole runs against the truth: how much roll and pitch shake, and whether the frame stays level.

Each folder of ``--runs`` holds ``run/`` (frames and stamps) and ``truth.tum``. Three odometries are made of its clouds:
*KISS-ICP* as it is, *registration* in ours (gravity from the first frame, no levelling after), and *levelled*, ours.
Needs kiss-icp. Steps are compared from frame to frame, in the body's axes; the lean is that of the odometry frame's z
against the truth's, so it holds what the truth itself leans against gravity.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bench.harness.rows import Row, informs, number, table
from coview_stream.clouds import read_tum
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import CloudError, InputError
from coview_stream.geometry.transforms import Poses, inverse, log_so3
from coview_stream.odometry.lidar_odometry import KissRegistration, LidarOdometry
from coview_stream.recordings.lidar_runs import open_bare_run
from coview_stream.recordings.run import Run

_NEAR = 0.05  # seconds between a frame and its truth


@dataclass(frozen=True)
class Scores:
    """Errors of an odometry: degrees and metres, root mean squares of steps from frame to frame and means of leans."""

    frames: int
    tilt: float
    yaw: float
    step: float
    lean: float
    most_lean: float


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
        for name, odometry in (("KISS-ICP", plain), ("registration", registered), ("levelled", levelled)):
            frames, poses = odometry(run)
            nearest = np.abs(run.stamps[frames][:, None] - stamps).argmin(axis=1)
            known = np.abs(stamps[nearest] - run.stamps[frames]) < _NEAR
            scores = scored(poses[known], truth[nearest[known]])
            details = {"run": folder.name, "odometry": name, **asdict(scores)}
            yield informs(f"odometry/{folder.name}, {name}: tilt per step", scores.tilt, "deg", details)


def plain(run: Run) -> tuple[list[int], Poses]:
    """KISS-ICP with its own prediction, from a level start; the frames, and their poses (N, 4, 4)."""
    icp = KissRegistration(LidarOdometryConfig())
    poses = [np.eye(4)]
    for k in range(len(run)):
        step = inverse(poses[-2]) @ poses[-1] if k > 1 else np.eye(4)
        poses.append(icp.register(run.read(k).points.astype(np.float64), poses[-1] @ step))
    return list(range(len(run))), np.array(poses[1:])


def registered(run: Run) -> tuple[list[int], Poses]:
    """Ours without levelling."""
    return _ours(run, LidarOdometryConfig(keep_level=False))


def levelled(run: Run) -> tuple[list[int], Poses]:
    """Ours."""
    return _ours(run, LidarOdometryConfig())


def _ours(run: Run, config: LidarOdometryConfig) -> tuple[list[int], Poses]:
    odometry, frames, poses = LidarOdometry(config), [], []
    for k in range(len(run)):
        frame = run.read(k)
        try:
            poses.append(odometry.step(frame.points, None, frame.stamp))
        except CloudError:
            continue
        frames.append(k)
    return frames, np.array(poses)


def scored(poses: Poses, truth: Poses) -> Scores:
    """Compare odometry with the truth, both (N, 4, 4), in frames of their own."""
    steps = [(inverse(each[k]) @ each[k + 1]) for k in range(len(poses) - 1) for each in (poses, truth)]
    pairs = list(zip(steps[::2], steps[1::2], strict=True))
    turned = np.degrees([log_so3(real[:3, :3].T @ made[:3, :3]) for made, real in pairs])
    shifted = np.array([made[:3, 3] - real[:3, 3] for made, real in pairs])
    sine = np.linalg.norm(np.cross(poses[:, 2, :3], truth[:, 2, :3]), axis=1)
    lean = np.degrees(np.arctan2(sine, (poses[:, 2, :3] * truth[:, 2, :3]).sum(axis=1)))
    return Scores(
        len(poses), _rms(turned[:, :2]), _rms(turned[:, 2]), float(np.sqrt((shifted**2).sum(axis=1).mean())),
        float(lean.mean()), float(lean.max()),
    )  # fmt: skip


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


_HEAD = ("run", "odometry", "frames", "roll, pitch deg", "yaw deg", "step m", "lean deg", "most deg")
_COLUMNS = (("tilt", 3), ("yaw", 3), ("step", 3), ("lean", 2), ("most_lean", 2))


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """All runs, and the code that was measured."""
    lines = [
        [each["run"], each["odometry"], str(each["frames"]), *(number(each[key], digits) for key, digits in _COLUMNS)]
        for each in (row.details for row in rows)
    ]
    return {"": f"{table(_HEAD, lines)}"}
