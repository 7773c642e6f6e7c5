"""Clouds as text, in the forms that programs write; and what is none is refused by its line."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.clouds import text
from coview_stream.clouds.files import is_cloud_name, read_cloud
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
        ("a.xyz", "\n".join(f"{x:.9e} {y:.9e} {z:.3f}" for x, y, z in POINTS)),
    ],
)  # fmt: skip
def test_points_are_read(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content.encode())
    found = read_cloud(path).map_points()
    assert found.shape == POINTS.shape
    np.testing.assert_allclose(found, POINTS, atol=0.02)


def test_many_lines_are_read_piece_by_piece(tmp_path, monkeypatch):
    monkeypatch.setattr(text, "_LINES", 30)
    path = tmp_path / "a.xyz"
    path.write_text("x y z\n" + lines(POINTS) + "\n# the end\n")
    np.testing.assert_allclose(read_cloud(path).map_points(), POINTS, atol=0.02)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.xyz", "1,5 2,5 3,5\n", r"a\.xyz:1: .*decimal commas"),
        ("a.xyz", "1 2\n3 4\n", r"a\.xyz:1: .*2 columns"),
        ("a.xyz", lines(POINTS[:50]) + "1 2 none\n" + lines(POINTS[:5]), r"a\.xyz:51: '1 2 none' is no point"),
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
