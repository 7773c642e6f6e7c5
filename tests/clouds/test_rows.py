"""Rows of numbers: text in the forms that programs write, and ``.bin`` files of any number of columns."""

import gzip

import numpy as np
import pytest

from coview_stream.clouds.files import is_cloud_name, read_cloud
from coview_stream.clouds.rows import likely_columns
from coview_stream.errors import CloudError

POINTS = np.round(np.random.default_rng(1).uniform((5e5, 5.4e6, 90), (5.001e5, 5.4001e6, 120), (400, 3)), 3)


def lines(points, mark=" ", more=""):
    return "".join(mark.join(f"{value:.3f}" for value in row) + more + "\n" for row in points)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.xyz", lines(POINTS)),
        ("a.xyz", lines(POINTS, "   ")),
        ("a.xyz", lines(POINTS, "\t", "\t120\t3")),
        ("a.asc", "# made by a scanner\n// X Y Z\n\n" + lines(POINTS)),
        ("a.csv", "X,Y,Z,Intensity\n" + lines(POINTS, ",", ",17")),
        ("a.csv", '"x";"y";"z"\n' + lines(POINTS, ";")),
        ("a.csv", "\ufeffNorthing,Easting,Height (m)\n" + lines(POINTS[:, (1, 0, 2)], ",")),
        ("a.txt", "  " + lines(POINTS).replace("\n", "\r\n")),
        ("a.pts", f"{len(POINTS)}\n" + lines(POINTS, " ", " -1200 128 128 128")),
        ("a.pts", f"200\n{lines(POINTS[:200])}200\n{lines(POINTS[200:])}"),
        ("a.txt", "name\tx\ty\tz\tclass\n\t" + lines(POINTS, "\t", "\t9").replace("\n", "\n\t")),
        ("a.xyz", "\n".join(f"{x:.9e} {y:.9e} {z:.3f}" for x, y, z in POINTS)),
    ],
)  # fmt: skip
def test_points_are_read(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content.encode())
    found = read_cloud(path).map_points()
    assert found.shape == POINTS.shape
    np.testing.assert_allclose(found, POINTS, atol=0.02)


def test_many_lines_are_read_piece_by_piece(tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text("x y z\n" + lines(POINTS) * 300 + "\n# the end\n")  # more than 100,000 lines
    np.testing.assert_allclose(read_cloud(path).map_points(), np.tile(POINTS, (300, 1)), atol=0.02)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.xyz", "1,5 2,5 3,5\n", r"a\.xyz:1: .*decimal commas"),
        ("a.xyz", "1 2\n3 4\n", r"a\.xyz:1: .*2 columns"),
        ("a.xyz", lines(POINTS[:50]) + "1 2 none\n" + lines(POINTS[:5]), r"a\.xyz:51: '1 2 none' is not a point"),
        ("a.csv", "a,b,c\n" * 200, "no point in the first 100 lines"),
        ("a.txt", "# only a comment\n", "no point"),
        ("a.xyz", "1" * 10_000, "a line of 10000 characters"),
        ("a.txt", "<html><body>404</body></html>", "HTML"),
        ("a.xyz", "LASF\0\0\0\0", "content is LAS"),
    ],
)
def test_what_is_no_point_is_named_by_its_line(tmp_path, name, content, says):
    (tmp_path / name).write_text(content)
    with pytest.raises(CloudError, match=says):
        read_cloud(tmp_path / name)


def test_text_in_a_folder_may_be_anything_and_is_no_cloud():
    assert is_cloud_name("a.xyz")
    assert is_cloud_name("a.pts")
    assert not is_cloud_name("times.txt")
    assert not is_cloud_name("data_stamp.csv")


COLUMNS = range(3, 9)


def scan(shuffled):
    """Points of a spinning scanner between two walls, (N, 3)."""
    rng = np.random.default_rng(3)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 0.4)), np.radians(np.arange(-15, 16, 2)))
    direction = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1).reshape(-1, 3)
    wall = 12.0 / np.maximum(np.abs(direction[:, 1]), 0.15)
    ground = np.where(direction[:, 2] < 0, -1.7 / np.minimum(direction[:, 2], -1e-6), np.inf)
    points = direction * np.minimum(wall, ground)[:, None] + rng.normal(0, 0.02, direction.shape)
    return rng.permutation(points) if shuffled else points


def bin_rows(points, columns, intensity):
    rng = np.random.default_rng(4)
    values = {
        "unit": rng.uniform(0, 1, len(points)),
        "zero": np.zeros(len(points)),
        "byte": rng.integers(0, 256, len(points)),
    }
    more = [values[intensity], rng.integers(0, 16, len(points)), rng.uniform(0, 0.1, len(points))]
    more += [rng.normal(0, 3, len(points)) for _ in range(2)]
    return np.column_stack([points, *more[: columns - 3]]).astype("<f4")


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("intensity", ["unit", "zero", "byte"])
@pytest.mark.parametrize("columns", COLUMNS)
def test_columns_are_told_from_the_numbers(columns, intensity, shuffled):
    assert likely_columns(bin_rows(scan(shuffled), columns, intensity).ravel(), 4) == columns


@pytest.mark.parametrize("columns", [3, 5, 6, 8])
def test_file_of_other_rows_is_refused_with_their_length(tmp_path, columns):
    path = tmp_path / "scan.bin"
    bin_rows(scan(False)[: 840 * 12], columns, "unit").tofile(path)
    with pytest.raises(CloudError, match=f"rows of {columns} float32"):
        read_cloud(path)


def test_rows_of_nuscenes_are_read_by_their_name(tmp_path):
    points = scan(False)[:10_000]
    bin_rows(points, 5, "byte").tofile(tmp_path / "n015__LIDAR_TOP__1.pcd.bin")
    np.testing.assert_allclose(read_cloud(tmp_path / "n015__LIDAR_TOP__1.pcd.bin").points, points, atol=1e-5)
    bin_rows(points, 4, "unit").tofile(tmp_path / "other.pcd.bin")
    with pytest.raises(CloudError, match="rows of 4 float32"):
        read_cloud(tmp_path / "other.pcd.bin")


def test_small_and_flat_files_are_taken_as_they_are_named(tmp_path):
    flat = np.zeros((5000, 4), "<f4")
    flat[:, :2] = np.random.default_rng(1).uniform(-50, 50, (5000, 2))
    assert likely_columns(flat.ravel(), 4) == 4
    assert likely_columns(np.random.default_rng(2).normal(size=900).astype("<f4"), 4) == 4
    noise = np.random.default_rng(2).normal(size=84_000).astype("<f4")
    assert likely_columns(noise, 4) == 4


def test_packed_text_is_read_and_a_bomb_is_not(tmp_path):
    packed = tmp_path / "a.xyz.gz"
    packed.write_bytes(gzip.compress(lines(POINTS).encode()))
    assert is_cloud_name(packed)
    np.testing.assert_allclose(read_cloud(packed).map_points(), POINTS, atol=2e-3)
    packed.write_bytes(gzip.compress(lines(POINTS).encode())[:-200])
    with pytest.raises(CloudError, match=r"a\.xyz\.gz: damaged or truncated gzip"):
        read_cloud(packed)
    packed.write_bytes(gzip.compress(b"1 2 3\n" * 5_000_000))
    with pytest.raises(CloudError, match=r"a\.xyz\.gz: unpacks to more than"):
        read_cloud(packed)
    packed.write_bytes(lines(POINTS).encode())
    with pytest.raises(CloudError, match="its content is text"):
        read_cloud(packed)
