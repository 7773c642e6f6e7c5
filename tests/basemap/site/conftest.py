"""A site of four tiles, for the modules here that do not build one of their own."""

import numpy as np
import pytest

from coview_stream.basemap.site.site_build import build_site
from coview_stream.clouds.files import write_cloud
from coview_stream.config import map_preset


@pytest.fixture(scope="module")
def site(map_points, tmp_path_factory):
    """The small world about the corner of four tiles, 512000, 5120000."""
    folder = tmp_path_factory.mktemp("four")
    write_cloud(folder / "yard.las", map_points + np.array([512_003.0, 5_120_005.0, 100.0]))
    assert len(build_site(folder / "yard.las", folder / "yard", map_preset("slam", learned=False)).manifest.tiles) == 4
    return folder / "yard"
