"""Localization of one scan, without odometry: a terrestrial scanner on its tripod, or a robot that stands still.

    coview-stream simulate world --scene campus --sensor os64 --length 0
    python examples/single_scan.py world/base.laz world/run/frames/000000.pcd

One scan alone has to provide the evidence that a drive collects over its keyframes.
"""

from __future__ import annotations

import sys
from pathlib import Path

from coview_stream import BaseMap, Fix
from coview_stream.geometry.protection import one_in
from coview_stream.localization.offline import locate
from coview_stream.recordings import open_run


def main(base: Path, scan: Path) -> Fix:
    """Print the scan's pose in the map, or why there is none; return the fix."""
    base_map = BaseMap.build(base, preset="tls")  # descriptors reach 100 m, as terrestrial scanners do
    # one cloud file is a run of one frame; its z axis has to point up
    fix = locate(base_map, open_run(scan)).fixes[-1]
    if fix.T_map_body is None:
        print(f"{fix.state.reported}: {fix.evidence.reason if fix.evidence else 'no evidence'}")
    else:
        print(f"{fix.state.reported}, wrong {one_in(1.0 - fix.confidence)}; from the levelled scan into the map:")
        print(fix.T_map_body.round(3))
    return fix


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
