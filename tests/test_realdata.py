"""Real scans: build the map, localize the run, compare with the truth.

The scans are no part of the repository. They are looked for in ``COVIEW_DATA``, else in ``../shared/data`` beside it.
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from nightly import nightly
from scipy.spatial import cKDTree

from coview_stream.basemap.basemap import BaseMap
from coview_stream.cli import main
from coview_stream.clouds.files import read_cloud
from coview_stream.clouds.trajectory import read_tum
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
@pytest.mark.parametrize("located", ["riverside_a"], indirect=True)
def test_map_of_a_site_in_utm_coordinates_lies_where_its_survey_does(located):
    _, _, folder, out = located
    base_map, survey = BaseMap.load(out / "site.coview"), read_cloud(folder / "base.laz")
    distance, _ = cKDTree(survey.map_points()).query(base_map.world_points())
    assert np.quantile(distance, 0.99) < 0.22  # half the diagonal of a voxel of 0.25 m
    assert np.abs(base_map.points).max() < 2000.0


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
    """The handheld run is not a part of the street."""
    _, _, _, out = located
    code = main(
        ["locate", str(out / "site.coview"), str(data("handheld_livox", "run")), "-o", str(tmp_path), "--no-pictures"]
    )
    assert code == 1
    assert (tmp_path / "trajectory.tum").read_text() == ""
    assert json.loads((tmp_path / "result.json").read_text())["state"] in ("SEARCHING", "AMBIGUOUS")
