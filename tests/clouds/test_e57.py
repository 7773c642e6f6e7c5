"""E57: scans by their poses, spherical and cartesian, invalid points left out; damaged files cost one error."""

import contextlib
import sys

import numpy as np
import pytest

from coview_stream.clouds.files import read_cloud
from coview_stream.errors import CloudError, DependencyError
from coview_stream.geometry.transforms import rot_z

pye57 = pytest.importorskip("pye57", reason="pye57 is not there; pip install 'coview-stream[e57]'")
POINTS = np.random.default_rng(1).uniform(-20, 20, (3000, 3))


@pytest.fixture
def two_scans(tmp_path):
    path = tmp_path / "site.e57"
    file = pye57.E57(str(path), mode="w")
    for k in range(2):
        data = {name: POINTS[k::2, axis].copy() for axis, name in enumerate(("cartesianX", "cartesianY", "cartesianZ"))}
        turn = np.array([np.cos(0.3 * k), 0.0, 0.0, np.sin(0.3 * k)])  # about z by 0.6 k
        file.write_scan_raw(data, rotation=turn, translation=np.array([5e5 + 10 * k, 5.4e6, 100.0]))
    file.close()
    return path


@pytest.mark.slow
def test_scans_are_joined_by_their_poses(two_scans):
    cloud = read_cloud(two_scans)
    expected = np.concatenate([POINTS[k::2] @ rot_z(0.6 * k).T + (5e5 + 10 * k, 5.4e6, 100.0) for k in range(2)])
    np.testing.assert_allclose(cloud.map_points(), expected, atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("size", [48, 500, 20_000])
def test_truncated_file_costs_one_error(two_scans, size):
    two_scans.write_bytes(two_scans.read_bytes()[:size])
    with pytest.raises(CloudError, match=r"site\.e57: damaged or truncated E57"):
        read_cloud(two_scans)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_changed_bytes_cost_an_error_or_points(two_scans, seed):
    raw = bytearray(two_scans.read_bytes())
    rng = np.random.default_rng(seed)
    for at in rng.integers(0, len(raw), 20):
        raw[at] = int(rng.integers(0, 256))
    two_scans.write_bytes(bytes(raw))
    with contextlib.suppress(CloudError):
        assert len(read_cloud(two_scans))


def test_missing_library_is_named_with_its_extra(two_scans, monkeypatch):
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(DependencyError, match="pye57"):
        read_cloud(two_scans)
