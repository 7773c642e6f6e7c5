"""``coview-stream build``: a map or one line, never half a map."""

import gzip
import io
import itertools
import json
import re
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS

from coview_stream.basemap.basemap import BaseMap
from coview_stream.cli import main
from coview_stream.cli.build import _announce
from coview_stream.clouds import progress
from coview_stream.clouds.files import write_cloud
from tests.clouds.las_file import written


@pytest.fixture
def cloud(map_points, tmp_path):
    path = tmp_path / "site.ply"
    write_cloud(path, map_points[(np.abs(map_points[:, :2]) < 9.0).all(axis=1)].astype(np.float32))
    return path


def test_build_writes_and_describes_a_map(cloud, tmp_path, capsys):
    target = tmp_path / "site.coview"
    options = ["--preset", "tls", "--rings", "5", "--sectors", "8", "--block-size", "3"]
    assert main(["build", str(cloud), "-o", str(target), *options, "--channels", "coview, scan_context"]) == 0
    out = capsys.readouterr().out
    built = BaseMap.load(target)
    assert built.config.block == 3.0
    config = built.descriptor_config
    assert (config.radius, config.rings, config.sectors) == (100.0, 5, 8)
    assert config.channels == ("coview", "scan_context")
    for fact in (f"{len(built)} stations", f"{len(built.points)} kept", f"{target.stat().st_size} bytes", " s,"):
        assert fact in out


def test_last_line_tells_what_the_map_covers_and_warnings_are_one_line_each(map_points, tmp_path, capsys):
    near = map_points[(np.abs(map_points[:, :2]) < 20.0).all(axis=1)]
    write_cloud(tmp_path / "thin.ply", near[:: len(near) // 6000])
    assert main(["build", str(tmp_path / "thin.ply"), "-o", str(tmp_path / "site.coview"), "--radius", "20"]) == 0
    captured = capsys.readouterr()
    last = captured.out.splitlines()[-1]
    assert last.startswith("40 x 40 m (12 x 12 m if in feet: build --crs feet) with points on ")
    for fact in ("points/m2", "heights -", "crs unknown", "per km2"):
        assert fact in last
    lines = captured.err.splitlines()
    assert [line for line in lines if "points/m2 are few" in line]
    assert all(line.startswith("coview-stream: warning: ") for line in lines if "warning" in line.lower())


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
def test_bad_build_options_are_refused(cloud, tmp_path, refused, options, text):
    assert text in refused("build", cloud, "-o", tmp_path / "site.coview", *options)
    assert [p.name for p in tmp_path.iterdir()] == ["site.ply"]


@pytest.mark.parametrize("name", ["none.laz", "text.ply", "empty.las", "few.npy", "nan.npy"])
def test_bad_cloud_files_are_refused_and_the_old_map_stays(cloud, world_file, tmp_path, refused, name):
    (tmp_path / "text.ply").write_text("no cloud\nat all\n")
    (tmp_path / "empty.las").write_bytes(b"")
    np.save(tmp_path / "few.npy", np.zeros((50, 3)))
    np.save(tmp_path / "nan.npy", np.full((5000, 3), np.nan))
    target = tmp_path / "site.coview"
    target.write_bytes(world_file.read_bytes())
    before = sorted(tmp_path.iterdir())
    error = refused("build", tmp_path / name, "-o", target)
    assert name in error or "points are left" in error
    if name in ("none.laz", "text.ply", "empty.las"):  # among good tiles too
        assert name in refused("build", cloud, tmp_path / name, "-o", target)
    assert sorted(tmp_path.iterdir()) == before
    assert target.read_bytes() == world_file.read_bytes()


def test_frames_of_a_run_are_no_map(cloud, tmp_path, refused, monkeypatch):
    frames = tmp_path / "run" / "frames"
    frames.mkdir(parents=True)
    shutil.copy(cloud, frames / "000000.ply")
    output = tmp_path / "site.coview"
    (tmp_path / "link").symlink_to(frames)
    monkeypatch.chdir(frames)
    for name in ("..", ".", "../frames/", tmp_path / "link", tmp_path / "run"):
        (tmp_path / "run" / "odometry.tum").write_text("0 0 0 0 0 0 0 1\n")
        assert "holds the frames of a run" in refused("build", name, "-o", output)
        (tmp_path / "run" / "odometry.tum").unlink()
        assert "holds the frames of a run" not in refused("build", name, "-o", tmp_path / "no" / "site.coview")


def test_missing_output_directory_is_refused_before_building(tmp_path, refused):
    assert "not a place for a file" in refused("build", tmp_path / "none.las", "-o", tmp_path / "no" / "site.coview")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    for cloud in ("none.las", "mine/thesis.txt"):
        assert "mine: is not a site, and not empty" in refused("build", tmp_path / cloud, "-o", tmp_path / "mine")


@pytest.mark.slow
def test_directory_of_tiles_is_built_converted_and_shown(cloud, tmp_path, capsys, monkeypatch, refused):
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / "cache"))
    assert "end the name of -o with a slash" in refused("build", cloud, "-o", tmp_path / "x.coview", "--workers", "2")
    site = f"{tmp_path}/site/"
    assert main(["build", str(cloud), "-o", site, "--workers", "1", "--no-learned"]) == 0
    assert re.search(r"\d+ tiles of 320 m, 0 as they were", out := capsys.readouterr().out)
    assert re.search(
        r"^1\d x 1\d m \(\d x \d m if in feet: build --crs feet\) with .* points/m2 kept, heights .* unknown, .* tiles",
        out,
        re.M,
    )
    assert main(["info", site, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["site"]["tiles"] > 0
    assert main(["convert", site, str(tmp_path / "one.coview")]) == 0
    assert main(["convert", str(tmp_path / "one.coview"), str(tmp_path / "back")]) == 0
    assert "tiles of 320 m" in capsys.readouterr().out
    (tmp_path / "thesis").write_text("years of work")
    assert "not a coview map" in refused("convert", site, tmp_path / "thesis")


def test_only_a_map_file_is_overwritten(cloud, tmp_path, refused):
    before = cloud.read_bytes()
    assert "one of the scans" in refused("build", cloud, "-o", cloud)
    assert "given twice" in refused("build", cloud, cloud, "-o", tmp_path / "site.coview")
    other = tmp_path / "thesis"
    other.write_text("years of work")
    assert "not a coview map" in refused("build", cloud, "-o", other)
    assert "not a regular file" in refused("build", cloud, "-o", "/dev/null")
    assert cloud.read_bytes() == before
    assert other.read_text() == "years of work"


@pytest.mark.parametrize(
    ("command", "output", "right"),
    [
        ("build", "site.las", "site.coview"),
        ("build", "out.txt", "out.coview"),
        ("build", "site.coview/", "site/"),
        ("convert", "two.coview", "two/"),
        ("convert", "one.laz", "one/"),
    ],
)
def test_map_has_no_name_of_another_format(cloud, world_file, tmp_path, refused, command, output, right):
    words = [cloud, "-o"] if command == "build" else [world_file]
    assert f"call it {right}" in refused(command, *words, f"{tmp_path}/{output}")
    assert not (tmp_path / output).exists()


@pytest.mark.slow
@pytest.mark.parametrize("output", ["site.coview", "site/"])
def test_reference_system_that_a_file_does_not_have_is_warned_of(map_points, tmp_path, capsys, output):
    system = WktCoordinateSystemVlr(CRS("EPSG:32632").to_wkt())
    near = map_points[(np.abs(map_points[:, :2]) < 9.0).all(axis=1)] + (448_000.0, 5_400_000.0, 90.0)
    written(tmp_path / "site.las", near, "1.4", 6, [system])
    words = ["build", str(tmp_path / "site.las"), "-o", f"{tmp_path}/{output}", "--no-learned", "--crs"]
    assert main([*words, "EPSG:25833"]) == 0
    said = capsys.readouterr()
    assert "site.las: in EPSG:32632" in said.err
    assert "ignored" in said.err
    assert "crs EPSG:32632" in said.out
    assert main([*words, "EPSG:32632"]) == 0
    assert "ignored" not in capsys.readouterr().err


STAGES = ("cleaning, finding normals", "finding the ground", "describing stations", "computing the likelihood field")


def test_bar_of_a_build_is_one_and_never_goes_back(cloud, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    BaseMap.build(cloud, radius=20.0, progress=True)
    shown = re.findall(r"\r(?:([^:\r]+): )? *(\d+)%", capsys.readouterr().err)
    stages = list(dict.fromkeys(stage for stage, _ in shown if stage))
    assert stages == ["reading", *STAGES]
    shares = [int(share) for _, share in shown]
    assert shares == sorted(shares)


def test_long_build_without_a_terminal_prints_a_line_for_each_stage(cloud, tmp_path, capsys, monkeypatch):
    seconds = itertools.count(0, 7)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: next(seconds)))
    assert main(["build", str(cloud), "-o", str(tmp_path / "site.coview"), "--radius", "20", "--no-learned"]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said == [f"after {14 + 7 * k} s: {stage}" for k, stage in enumerate(STAGES)]


def test_large_build_says_how_long_it_takes(tmp_path, capsys):
    corners = np.array([[0.0, 0.0, 0.0], [2000.0, 1000.0, 10.0]])
    write_cloud(tmp_path / "town.las", corners, origin=[448_000.0, 5_400_000.0, 90.0])
    _announce([str(tmp_path / "town.las")], tiles=False)
    assert re.search(r"0\.0 million points on 2 km2: 3 min .* a map of 0\.7 GB", capsys.readouterr().err)


@pytest.fixture
def stdin(monkeypatch):
    """Sets the bytes that come on stdin."""
    return lambda sent: monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(sent)))


@pytest.mark.parametrize("name", ["-", "/dev/stdin"])
def test_stdin_that_is_no_cloud_is_called_stdin(tmp_path, stdin, refused, name):
    for sent, found in ((b"", "stdin: nothing came (0 bytes)"), (b"hello\n", "stdin: no point in the first 100 lines")):
        stdin(sent)
        assert f"error: {found}" in refused("build", name, "-o", tmp_path / "x.coview")


@pytest.mark.slow
@pytest.mark.parametrize("packed", [False, True], ids=["xyz", "xyz.gz"])
def test_cloud_on_stdin_is_read_by_its_first_bytes(map_points, tmp_path, capsys, stdin, refused, packed):
    near = map_points[(np.abs(map_points[:, :2]) < 8.0).all(axis=1)]
    text = "\n".join("{:.2f} {:.2f} {:.2f}".format(*row) for row in near).encode()
    stdin(gzip.compress(text) if packed else text)
    assert main(["build", "-", "-o", str(tmp_path / "site.coview"), "--radius", "20", "--no-learned"]) == 0
    assert f"{len(near)} points read" in capsys.readouterr().out
    stdin(b"PK\x03\x04\0\0")
    assert "stdin is not a cloud" in refused("build", "-", "-o", tmp_path / "x.coview")
