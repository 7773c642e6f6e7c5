"""``coview-stream fuse``: merge localized runs with the base map."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from coview_stream.cli.map_argument import add_map, open_map_argument
from coview_stream.cli.options import add_shared, check_picture, lidar_config, mount_of

HELP = "merge localized runs with the base map: one cloud, tagged by source and change"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; ranges are checked by FuseConfig."""
    add_map(parser)
    parser.add_argument(
        "pairs", nargs="+", metavar="RUN:OUT", help="a run, and the output of `locate` for it on this map"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FUSED.laz", help="las, laz, ply, pcd, npy")
    parser.add_argument("--voxel", type=float, metavar="M", help="metres from point to point, at least (the map's)")
    parser.add_argument("--min-range", type=float, default=1.5, metavar="M", help="nearer points are left out (1.5)")
    parser.add_argument("--max-range", type=float, default=50.0, metavar="M", help="farther points are left out (50)")
    parser.add_argument("--keep-moving", action="store_true", help="keep people and cars that drove")
    parser.add_argument("--changes", action="store_true", help="tag new and gone points")
    parser.add_argument(
        "--joint", action="store_true", help="adjust the runs' poses to each other and to the map first"
    )
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the cloud from above")
    parser.add_argument("--odometry", default="auto", metavar="auto|FILE|kiss-icp", help="as given to `locate` (auto)")
    add_shared(parser, "--gravity", "--mount", "--cloud-delay", "--cloud-topic", "--odometry-topic")
    add_shared(parser, "--verify-key", "--progress")


def run(args: argparse.Namespace) -> int:
    """Write the cloud, the names of its sources and the picture; print a summary."""
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.clouds.progress import progress_bar
    from coview_stream.config.mount import Mount
    from coview_stream.errors import counted, require_library
    from coview_stream.fusion.fuse import FuseConfig, check_count, fuse
    from coview_stream.fusion.fused_file import check_name, summary, write_fused, write_trajectories
    from coview_stream.fusion.localized_run import LocalizedRun, parse_pair
    from coview_stream.odometry.lidar_odometry import LidarOdometry
    from coview_stream.recordings.open_run import open_run
    from coview_stream.recordings.run import Run

    pairs = [parse_pair(text) for text in args.pairs]
    check_count(len(pairs))
    open_map_argument(args)
    check_name(args.output, [args.map, *(path for pair in pairs for path in (pair.run, pair.trajectory, pair.result))])
    check_picture("--picture", args.picture)
    if args.picture is not None:
        require_library("matplotlib", "matplotlib>=3.8", "--picture")
    given = mount_of(args)
    lidar_options = lidar_config(args.odometry, args.gravity, delay=args.cloud_delay)
    base_map = BaseMap.load(args.map, verify_key=args.verify_key)
    config = FuseConfig(
        voxel=base_map.config.voxel if args.voxel is None else args.voxel,
        range_min=args.min_range, range_max=args.max_range, keep_moving=args.keep_moving, changes=args.changes,
    )  # fmt: skip

    def open_it(path: Path, mount: Mount | None) -> Run:
        lidar = None if lidar_options is None else LidarOdometry(lidar_options)
        return open_run(path, args.odometry, args.cloud_topic, args.odometry_topic, lidar, None, given or mount)

    runs = [LocalizedRun(pair, base_map, open_it, args.cloud_delay or 0.0) for pair in pairs]
    for note in (note for each in runs for note in each.notes):
        print(note, file=sys.stderr)
    with progress_bar("fusing", args.progress or None, "frame") as follow:
        joint = None
        if args.joint:
            from coview_stream.fusion.joint import adjust

            joint = adjust(base_map, runs, follow)
            for each, poses in zip(runs, joint.poses, strict=True):
                each.poses = poses
        fused = fuse(base_map, runs, config, follow)
    write_fused(fused, args.output, [str(pair.run) for pair in pairs])
    if joint is not None:
        print(joint.said())
        names = write_trajectories(args.output, runs)
        kept = "adjusted" if joint.accepted else "as locate had them"
        print(f"{', '.join(names)}: trajectories of the runs, {kept}")
    if args.picture is not None:
        from coview_stream.fusion.fused_file import draw_fused

        draw_fused(fused, args.picture, f"{args.map.stem} and {counted(len(runs), 'run')}")
    print(summary(fused, [str(pair.run) for pair in pairs], args.changes))
    print(f"{args.output}: {len(fused):,} points; sources are named in {args.output.name}.json")
    return 0
