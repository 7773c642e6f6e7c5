"""``coview-stream airborne``: a point cloud as from the air, made from a ground survey.

A separate command instead of an option of ``simulate``: it turns a cloud into a cloud, from which ``build`` makes a
map; it has no robot and no truth, and none of a simulated world's options apply.
"""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "make an airborne-like cloud of a ground survey: seen from above, no facades, thinned"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; ranges are checked by Survey."""
    parser.add_argument("surveys", type=Path, nargs="+", metavar="SURVEY", help="clouds of one ground survey, z up")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.laz", help="cloud to write")
    parser.add_argument("--density", type=float, default=8.0, help="pulses per square metre (8)")
    parser.add_argument("--swath", type=float, default=26.0, help="scan angle to either side, degrees (26)")
    parser.add_argument("--noise", type=float, default=0.025, help="noise of the range, metres, one sigma (0.025)")
    parser.add_argument("--porosity", type=float, default=0.5, help="probability to pass a layer of foliage (0.5)")
    parser.add_argument("--misaligned", type=float, default=0.0, help="shift of strips, metres, one sigma (0)")
    parser.add_argument("--seed", type=int, default=1, help="equal seeds give equal clouds (1)")


def run(args: argparse.Namespace) -> int:
    """Write the cloud, in the survey's own coordinates, and print its counts."""
    from coview_stream.clouds import merge, read_cloud, write_cloud
    from coview_stream.clouds.files import WRITABLE_SUFFIXES
    from coview_stream.errors import CloudError
    from coview_stream.sim.airborne import Survey, airborne_survey

    names = ("density", "swath", "noise", "porosity", "misaligned", "seed")
    survey = Survey(**{name: getattr(args, name) for name in names})
    if args.output.suffix.lower() not in WRITABLE_SUFFIXES:
        raise CloudError(f"{args.output}: name a cloud, one of {', '.join(sorted(WRITABLE_SUFFIXES))}")
    if args.output.resolve() in [path.resolve() for path in args.surveys]:
        raise CloudError(f"{args.output}: is the survey itself; name another file")
    cloud = merge([read_cloud(path) for path in args.surveys])
    seen = airborne_survey(cloud.points, survey)
    write_cloud(args.output, seen, origin=cloud.origin)
    print(f"{args.output}: {len(seen)} of {len(cloud)} points")
    return 0
