"""Real scans: build the map, localize the run, compare with the truth.

The scans are no part of the repository. They are looked for in ``COVIEW_DATA``, else in ``../shared/data`` beside it.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from nightly import nightly

from coview_stream.basemap.basemap import BaseMap
from coview_stream.cli import main
from coview_stream.clouds.trajectory import read_tum, write_tum
from coview_stream.report.evaluation import evaluate

pytestmark = pytest.mark.realdata

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("COVIEW_DATA", ROOT.parent / "shared" / "data"))
SETS = ("riverside_a", "kitti04", "handheld_livox")


def data(*names: str) -> Path:
    path = DATA.joinpath(*names)
    if not path.exists():
        pytest.skip(f"real scans {path} are not here; name their folder in COVIEW_DATA")
    return path


@pytest.fixture(scope="module")
def located(request, tmp_path_factory):
    """Exit codes of build and locate, and the folder of the results."""
    folder = data(request.param)
    out = tmp_path_factory.mktemp(request.param)
    built = main(["build", str(folder / "base.laz"), "-o", str(out / "site.coview")])
    code = main(["locate", str(out / "site.coview"), str(folder / "run"), "-o", str(out), "--no-pictures"])
    return built, code, folder, out


@pytest.mark.slow
@pytest.mark.parametrize("located", SETS, indirect=True)
def test_real_run_is_localized(located):
    built, code, folder, out = located
    assert (built, code) == (0, 0)
    verdict = evaluate(read_tum(out / "trajectory.tum"), read_tum(folder / "truth.tum"))
    assert verdict.success
    assert verdict.false_frames == 0
    assert verdict.unmatched == 0
    assert verdict.share_localised > 0.7
    assert verdict.translation.mean < 0.08
    assert verdict.rotation.mean < 0.3
    assert json.loads((out / "result.json").read_text())["state"] == "TRACKING"


@pytest.mark.slow
@nightly
def test_real_run_is_localized_on_an_airborne_like_map(tmp_path):
    """Seen from above, thinned to 8 pulses per square metre, without facades."""
    folder = data("kitti04")
    air, site = tmp_path / "air.laz", tmp_path / "site.coview"
    assert main(["airborne", str(folder / "base.laz"), "-o", str(air), "--density", "8"]) == 0
    assert main(["build", str(air), "-o", str(site)]) == 0
    assert main(["locate", str(site), str(folder / "run"), "-o", str(tmp_path / "out"), "--no-pictures"]) == 0
    verdict = evaluate(read_tum(tmp_path / "out" / "trajectory.tum"), read_tum(folder / "truth.tum"))
    assert verdict.success
    assert verdict.false_frames == 0
    assert verdict.share_localised > 0.8
    assert verdict.translation.mean < 0.1
    assert verdict.rotation.mean < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("located", ["kitti04"], indirect=True)
def test_real_run_on_wrong_map_gets_no_pose(located, tmp_path):
    """The handheld run is no part of the street."""
    _, _, _, out = located
    code = main(
        ["locate", str(out / "site.coview"), str(data("handheld_livox", "run")), "-o", str(tmp_path), "--no-pictures"]
    )
    assert code == 1
    assert (tmp_path / "trajectory.tum").read_text() == ""
    assert json.loads((tmp_path / "result.json").read_text())["state"] in ("SEARCHING", "AMBIGUOUS")


@pytest.mark.slow
@pytest.mark.parametrize("located", ["kitti04"], indirect=True)
def test_far_odometry_origin_changes_nothing(located, tmp_path):
    """UTM-like odometry of a real run: the same poses to a millimetre or so."""
    _, _, folder, out = located
    stamps, poses = read_tum(folder / "run" / "odometry.tum")
    away = poses.copy()
    away[:, :3, 3] += [443_000.0, 5_900_000.0, -60.0]
    write_tum(tmp_path / "far.tum", stamps, away)
    code = main(
        [
            *("locate", str(out / "site.coview"), str(folder / "run"), "-o", str(tmp_path), "--no-pictures"),
            *("--odometry", str(tmp_path / "far.tum")),
        ]
    )
    assert code == 0
    here, there = read_tum(out / "trajectory.tum"), read_tum(tmp_path / "trajectory.tum")
    np.testing.assert_array_equal(here[0], there[0])
    np.testing.assert_allclose(there[1], here[1], atol=5e-3)


@pytest.mark.slow
def test_utm_coordinates_of_a_real_site_are_kept(tmp_path):
    """The map of a road at UTM-like coordinates lies where its source says."""
    import laspy

    source = data("riverside_a", "base.laz")
    base_map = BaseMap.build(source, outlier_neighbours=0, radius=30.0, block=4.0)
    with laspy.open(source) as reader:
        low, high = np.array(reader.header.mins), np.array(reader.header.maxs)
    there = base_map.points + base_map.origin
    np.testing.assert_allclose(there.min(axis=0), low, atol=0.5)
    np.testing.assert_allclose(there.max(axis=0), high, atol=0.5)
    assert np.abs(base_map.points).max() < 2000
