"""``coview-stream build``: a map or one line, never half a map."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.cli import main
from coview_stream.clouds.files import write_cloud


@pytest.fixture
def cloud(map_points, tmp_path):
    path = tmp_path / "site.ply"
    write_cloud(path, map_points[(np.abs(map_points[:, :2]) < 9.0).all(axis=1)].astype(np.float32))
    return path


def one_line(capsys):
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("coview-stream: error: ")
    assert captured.err.count("\n") == 1
    return captured.err


def test_build_writes_and_describes_a_map(cloud, tmp_path, capsys):
    target = tmp_path / "site.coview"
    assert main(["build", str(cloud), "-o", str(target), "--radius", "20", "--block-size", "3"]) == 0
    out = capsys.readouterr().out
    built = BaseMap.load(target)
    assert built.config.block == 3.0
    assert built.descriptor_config.radius == 20.0
    for fact in (f"{len(built)} stations", f"{len(built.points)} kept", f"{target.stat().st_size} bytes", " s,"):
        assert fact in out


def test_last_line_tells_what_the_map_covers_and_warnings_are_one_line_each(map_points, tmp_path, capsys):
    near = map_points[(np.abs(map_points[:, :2]) < 20.0).all(axis=1)]
    write_cloud(tmp_path / "thin.ply", near[:: len(near) // 6000])
    assert main(["build", str(tmp_path / "thin.ply"), "-o", str(tmp_path / "site.coview"), "--radius", "20"]) == 0
    captured = capsys.readouterr()
    last = captured.out.splitlines()[-1]
    assert last.startswith("40 x 40 m with points on ")
    for fact in ("points/m2", "heights -", "crs unknown", "per km2"):
        assert fact in last
    lines = captured.err.splitlines()
    assert [line for line in lines if "points/m2 are few" in line]
    assert all(line.startswith("coview-stream: warning: ") for line in lines if "warning" in line.lower())


def test_preset_channels_and_descriptor_options(cloud, tmp_path):
    target = tmp_path / "site.coview"
    options = ["--preset", "tls", "--rings", "5", "--sectors", "8"]
    options += ["--channels", "coview, scan_context"]
    assert main(["build", str(cloud), "-o", str(target), *options]) == 0
    config = BaseMap.load(target).descriptor_config
    assert config.radius == 100.0
    assert config.channels == ("coview", "scan_context")
    assert (config.rings, config.sectors) == (5, 8)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--radius", "-3"], "radius"),
        (["--radius", "wide"], "--radius"),
        (["--block-size", "0"], "block"),
        (["--channels", "colour"], "channels"),
        (["--preset", "indoor"], "--preset"),
        (["--rings", "2"], "rings"),
        (["--no-such-option"], "--no-such-option"),
    ],
)
def test_bad_build_options_are_refused(cloud, tmp_path, capsys, options, text):
    assert main(["build", str(cloud), "-o", str(tmp_path / "site.coview"), *options]) == 2
    assert text in one_line(capsys)
    assert [p.name for p in tmp_path.iterdir()] == ["site.ply"]


@pytest.mark.parametrize("name", ["none.laz", "text.ply", "empty.las", "few.npy", "nan.npy"])
def test_bad_cloud_files_are_refused(tmp_path, capsys, name):
    (tmp_path / "text.ply").write_text("no cloud\nat all\n")
    (tmp_path / "empty.las").write_bytes(b"")
    np.save(tmp_path / "few.npy", np.zeros((50, 3)))
    np.save(tmp_path / "nan.npy", np.full((5000, 3), np.nan))
    before = sorted(tmp_path.iterdir())
    assert main(["build", str(tmp_path / name), "-o", str(tmp_path / "site.coview")]) == 2
    error = one_line(capsys)
    assert name in error or "points are left" in error
    assert sorted(tmp_path.iterdir()) == before


def test_one_bad_tile_fails_the_build(cloud, tmp_path, capsys):
    (tmp_path / "bad.ply").write_text("nonsense")
    assert main(["build", str(cloud), str(tmp_path / "bad.ply"), "-o", str(tmp_path / "site.coview")]) == 2
    assert "bad.ply" in one_line(capsys)
    assert not (tmp_path / "site.coview").exists()


def test_failed_build_keeps_the_old_map(cloud, tmp_path, capsys):
    target = tmp_path / "site.coview"
    target.write_bytes(b"the old map")
    assert main(["build", str(tmp_path / "none.las"), "-o", str(target)]) == 2
    one_line(capsys)
    assert target.read_bytes() == b"the old map"


def test_missing_output_directory_is_refused_before_building(tmp_path, capsys):
    assert main(["build", str(tmp_path / "none.las"), "-o", str(tmp_path / "no" / "site.coview")]) == 2
    assert "not a place for a file" in one_line(capsys)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    for cloud in ("none.las", "mine/thesis.txt"):
        assert main(["build", str(tmp_path / cloud), "-o", str(tmp_path / "mine")]) == 2
        assert "mine: is no site, and not empty" in one_line(capsys)


@pytest.mark.slow
def test_directory_of_tiles_is_built_converted_and_shown(cloud, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / "cache"))
    assert main(["build", str(cloud), "-o", str(tmp_path / "x.coview"), "--workers", "2"]) == 2
    assert "end the name of -o with a slash" in one_line(capsys)
    site = f"{tmp_path}/site/"
    assert main(["build", str(cloud), "-o", site, "--workers", "1", "--no-learned"]) == 0
    assert re.search(r"\d+ tiles of 320 m, 0 of them as they were.* MB per km2", capsys.readouterr().out)
    assert main(["info", site, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["site"]["tiles"] > 0
    assert main(["convert", site, str(tmp_path / "one.coview")]) == 0
    assert main(["convert", str(tmp_path / "one.coview"), str(tmp_path / "back")]) == 0
    assert "tiles of 320 m" in capsys.readouterr().out
    assert main(["convert", site, str(cloud)]) == 2
    assert "no coview map" in one_line(capsys)


def test_only_a_map_file_is_overwritten(cloud, tmp_path, capsys):
    before = cloud.read_bytes()
    assert main(["build", str(cloud), "-o", str(cloud)]) == 2
    assert "one of the scans" in one_line(capsys)
    other = tmp_path / "thesis.txt"
    other.write_text("years of work")
    assert main(["build", str(cloud), "-o", str(other)]) == 2
    assert "no coview map" in one_line(capsys)
    assert main(["build", str(cloud), "-o", "/dev/null"]) == 2
    assert "not a regular file" in one_line(capsys)
    assert cloud.read_bytes() == before
    assert other.read_text() == "years of work"


def test_duplicate_source_is_refused(cloud, tmp_path, capsys):
    assert main(["build", str(cloud), str(cloud), "-o", str(tmp_path / "site.coview")]) == 2
    assert "given twice" in one_line(capsys)
