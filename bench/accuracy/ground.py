"""Score the ground filter against labelled LAS files: ``python -m bench.ground FILE.laz ...``."""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np

from coview_stream.basemap.ground import GroundConfig, ground_mask, ground_surface
from coview_stream.clouds import read_cloud

_GROUND_CLASS = 2


def main() -> None:
    """Print type I, II and total error, the height error at labelled ground, seconds and peak memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", help="LAS or LAZ with ground labelled as class 2")
    parser.add_argument("--method", default="auto", choices=["auto", "cloth", "morphological"])
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=VALUE", help="fields of GroundConfig")
    options = parser.parse_args()
    fields = dict(item.split("=") for item in options.set)
    config = GroundConfig(
        method=options.method, **{k: type(getattr(GroundConfig(), k))(float(v)) for k, v in fields.items()}
    )
    print(
        f"{'file':<22}{'points':>10}{'type I':>8}{'type II':>8}{'total':>8}{'|dz| p50':>10}{'p95':>7}"
        f"{'share':>7}{'s':>7}{'MB':>7}"
    )
    for file in options.files:
        cloud = read_cloud(file)
        start = time.perf_counter()
        mask = ground_mask(cloud.points, config)
        seconds = time.perf_counter() - start
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        scores = f"{'-':>8}{'-':>8}{'-':>8}{'-':>10}{'-':>7}"
        if cloud.classification is not None and (cloud.classification == _GROUND_CLASS).any():
            label = cloud.classification == _GROUND_CLASS
            surface = ground_surface(cloud.points, config)
            ground = cloud.points[label]
            dz = np.abs(ground[:, 2] - surface.height_at(ground[:, :2]))
            p50, p95 = np.percentile(dz, [50, 95])
            first, second = (label & ~mask).sum() / label.sum(), (~label & mask).sum() / (~label).sum()
            scores = f"{first:8.2%}{second:8.2%}{(label != mask).mean():8.2%}{p50:10.3f}{p95:7.3f}"
        name = file.rsplit("/", 1)[-1]
        print(f"{name:<22}{len(mask):>10}{scores}{mask.mean():7.1%}{seconds:7.1f}{peak:7.0f}", flush=True)


if __name__ == "__main__":
    main()
