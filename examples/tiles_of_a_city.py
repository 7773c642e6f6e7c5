"""A map as a directory of tiles: built out of core, updated, and opened like a file.

coview-stream demo && python examples/tiles_of_a_city.py coview-demo/world city
"""

from __future__ import annotations

import sys
from pathlib import Path

from coview_stream import BaseMap
from coview_stream.basemap.site.executors import ProcessExecutor
from coview_stream.basemap.site.site_build import build_site
from coview_stream.config import map_preset


def main(world: Path, directory: Path, workers: int = 2) -> BaseMap:
    """Build, build again, and return the map."""
    config = map_preset("slam", learned=False)
    for _ in range(2):  # the second time every tile is done already
        executor = ProcessExecutor(workers)
        try:
            built = build_site(world / "base.laz", directory, config, executor=executor)
        finally:
            executor.close()
        tiles = built.manifest.tiles
        print(f"{len(tiles)} tiles, {built.reused} as they were, {built.manifest.nbytes / 1e6:.1f} MB")
    print(f"manifest {built.manifest.sha256[:12]}")  # the same with any number of workers
    return BaseMap.load(directory)


if __name__ == "__main__":  # workers import this file; without this line they would start the build again
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
