"""Files of every format, in the variants that other programs write; folders and patterns of them."""

import struct

import numpy as np
import pytest

from coview_stream.clouds import merge, read_cloud, write_cloud
from coview_stream.clouds.files import expand_cloud_paths
from coview_stream.clouds.pcd import lzf_decompress
from coview_stream.errors import CloudError, CoViewWarning

POINTS = np.random.default_rng(1).normal(0, 20, (300, 3)).astype(np.float32)
UTM = np.array([351_154.5, 4_025_876.25, 14.0])
SUFFIXES = [".pcd", ".ply", ".npy", ".las", ".laz", ".bin"]
TOLERANCE = {".las": 6e-4, ".laz": 6e-4}


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_cloud_file_round_trip(tmp_path, suffix):
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, POINTS)
    cloud = read_cloud(path)
    assert cloud.points.dtype == np.float32
    assert not cloud.origin.any()
    assert cloud.dropped == 0
    np.testing.assert_allclose(cloud.points, POINTS, rtol=0, atol=TOLERANCE.get(suffix, 0.0))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", SUFFIXES[:-1])
def test_utm_coordinates_keep_millimetres(tmp_path, suffix):
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, POINTS, origin=UTM)
    cloud = read_cloud(path)
    assert np.abs(cloud.points).max() < 500
    assert (cloud.origin % 100 == 0).all()
    np.testing.assert_allclose(cloud.map_points(), POINTS + UTM, rtol=0, atol=1e-3)


def test_bin_format_refuses_utm_coordinates(tmp_path):
    with pytest.raises(CloudError, match="10 km"):
        write_cloud(tmp_path / "a.bin", POINTS, origin=UTM)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npy", ".bin"])
def test_non_finite_and_huge_rows_are_dropped_and_counted(tmp_path, suffix):
    points = POINTS.copy()
    points[3, 1], points[5, 0], points[7, 2] = np.nan, np.inf, 1e30
    write_cloud(tmp_path / f"a{suffix}", points)
    cloud = read_cloud(tmp_path / f"a{suffix}")
    assert cloud.dropped == 3
    np.testing.assert_array_equal(cloud.points, np.delete(POINTS, [3, 5, 7], axis=0))


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_with_fields_of_any_order_and_type(tmp_path, encoding):
    kind = np.dtype([("i", "u1"), ("z", "<f8"), ("n", "<f4", (3,)), ("x", "<f4"), ("y", "<i2")])
    rows = np.zeros(50, kind)
    rows["x"], rows["y"], rows["z"], rows["n"] = POINTS[:50, 0], np.arange(50), POINTS[:50, 2], 7.0
    if encoding == "ascii":
        body = "".join(f"{r['i']} {r['z']} 1 nan 3 {r['x']} {r['y']}\n" for r in rows).encode()
    elif encoding == "binary":
        body = rows.tobytes()
    else:  # one field after another, in literal runs of LZF
        data = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in kind.names)
        packed = b"".join(bytes([len(run) - 1]) + run for run in (data[i : i + 32] for i in range(0, len(data), 32)))
        body = struct.pack("<II", len(packed), len(data)) + packed
    (tmp_path / "a.pcd").write_bytes(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS i z n x y\nSIZE 1 8 4 4 2\nTYPE U F F F I\nCOUNT 1 1 3 1 1\n"
        f"WIDTH 50\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 50\nDATA {encoding}\n".encode()
        + body
    )
    expected = np.column_stack([rows["x"], rows["y"], rows["z"]])
    np.testing.assert_allclose(read_cloud(tmp_path / "a.pcd").points, expected, atol=1e-5)


def test_lzf_back_references_repeat_and_overlap():
    # "ab", then 5 from distance 2 (it overlaps its own output), then a long one of 7 + 3 + 2 from distance 7
    packed = bytes([1]) + b"ab" + bytes([3 << 5, 1]) + bytes([7 << 5, 3, 6])
    assert lzf_decompress(packed, 19) == b"ab" + b"ababa" + (b"abababa" * 2)[:12]
    with pytest.raises(ValueError, match="before the start"):
        lzf_decompress(bytes([1 << 5, 9]), 3)
    with pytest.raises(ValueError, match="instead of"):
        lzf_decompress(packed, 18)


@pytest.mark.parametrize("order", ["little", "big"])
def test_ply_vertices_after_another_element(tmp_path, order):
    sign = "<" if order == "little" else ">"
    header = (
        f"ply\nformat binary_{order}_endian 1.0\ncomment made by hand\nelement camera 2\nproperty double f\n"
        "element vertex 40\nproperty uchar red\nproperty double x\nproperty float y\nproperty short z\n"
        "element face 1\nproperty list uchar int v\nend_header\n"
    )
    rows = np.zeros(40, np.dtype([("r", "u1"), ("x", f"{sign}f8"), ("y", f"{sign}f4"), ("z", f"{sign}i2")]))
    rows["x"], rows["y"], rows["z"] = POINTS[:40, 0], POINTS[:40, 1], np.arange(40)
    path = tmp_path / "a.ply"
    path.write_bytes(header.encode() + struct.pack(f"{sign}2d", 1, 2) + rows.tobytes())
    np.testing.assert_allclose(read_cloud(path).points, np.column_stack([rows["x"], rows["y"], rows["z"]]), atol=1e-6)


def test_ply_ascii_is_read(tmp_path):
    path = tmp_path / "a.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int v\nelement vertex 2\n"
        "property float z\nproperty float x\nproperty float y\nend_header\n3 1 2 3\n3 1 2\n6 4 5\n"
    )
    np.testing.assert_array_equal(read_cloud(path).points, [[1, 2, 3], [4, 5, 6]])


def test_merge_rebases_in_float64(tmp_path):
    for name, shift in (("a", 0.0), ("b", 12_345.678)):
        write_cloud(tmp_path / f"{name}.npy", POINTS, origin=UTM + shift)
    clouds = [read_cloud(tmp_path / f"{name}.npy") for name in "ab"]
    merged = merge(clouds)
    expected = np.concatenate([POINTS + UTM, POINTS + UTM + 12_345.678])
    np.testing.assert_allclose(merged.map_points(), expected, rtol=0, atol=2e-3)
    with pytest.raises(CloudError, match="at least one"):
        merge([])


@pytest.fixture
def folder(tmp_path):
    for name in ("tile10.laz", "tile2.laz", "tile1.las", ".hidden.laz", "site.coview", "notes.txt", "tile3.laz.part"):
        (tmp_path / "tiles" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "tiles" / name).touch()
    return tmp_path / "tiles"


def test_folder_means_its_clouds_in_natural_order(folder):
    assert [path.name for path in expand_cloud_paths([folder])] == ["tile1.las", "tile2.laz", "tile10.laz"]


def test_patterns_and_names_may_be_mixed_and_named_files_are_left_to_their_reader(folder):
    (folder / "scan[1].ply").touch()
    names = ["tile1.las", "none.laz", "notes.txt", "scan[1].ply"]
    paths = expand_cloud_paths([folder / "tile*.laz", *(folder / name for name in names)])
    assert [path.name for path in paths] == ["tile2.laz", "tile10.laz", *names]


def test_folder_or_pattern_without_clouds_says_so(folder, tmp_path):
    with pytest.raises(CloudError, match=r"holds no cloud .*did you mean .*tiles\?"):
        expand_cloud_paths([tmp_path])
    (tmp_path / "site.laz").touch()
    with pytest.warns(CoViewWarning, match="clouds in subfolders, such as .*, are not read"):
        expand_cloud_paths([tmp_path])
    (tmp_path / "empty").mkdir()
    with pytest.raises(CloudError, match=r"holds no cloud .*name another folder"):
        expand_cloud_paths([tmp_path / "empty"])
    with pytest.raises(CloudError, match="no cloud has such a name"):
        expand_cloud_paths([folder / "*.ply"])
