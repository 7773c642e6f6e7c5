"""``coview-stream airborne``: a cloud in, a cloud out."""

import numpy as np
import pytest

from coview_stream.cli import main
from coview_stream.clouds import read_cloud, write_cloud

ORIGIN = np.array([412_000.0, 5_318_000.0, 240.0])


@pytest.fixture
def survey(tmp_path):
    """A wall on flat ground, at UTM-like coordinates."""
    rng = np.random.default_rng(0)
    ground = rng.uniform([-20.0, -20.0, 0.0], [20.0, 20.0, 0.02], (60_000, 3))
    wall = rng.uniform([-15.0, 4.0, 0.0], [15.0, 4.02, 6.0], (10_000, 3))
    write_cloud(tmp_path / "base.laz", np.concatenate([ground, wall]), origin=ORIGIN)
    return tmp_path / "base.laz"


@pytest.mark.slow
def test_a_survey_becomes_an_airborne_like_cloud(survey, tmp_path, capsys):
    out = tmp_path / "air.laz"
    assert main(["airborne", str(survey), "-o", str(out), "--density", "4"]) == 0
    assert "of 70000 points" in capsys.readouterr().out
    seen = read_cloud(out).map_points() - ORIGIN
    assert len(seen) / 1600.0 == pytest.approx(4.0, rel=0.3)
    assert np.abs(seen[:, :2]).max() < 21.0
    assert ((seen[:, 2] > 0.3) & (seen[:, 2] < 5.0)).mean() < 0.005


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-o", "air.txt"], "name a cloud"),
        (["-o", "base.laz"], "the survey itself"),
        (["-o", "air.laz", "--density", "0"], "density"),
    ],
)
def test_what_cannot_be_made_is_refused_in_words(survey, tmp_path, monkeypatch, refused, words, said):
    monkeypatch.chdir(tmp_path)
    assert said in refused("airborne", survey, *words)
    assert read_cloud(survey).points.shape == (70_000, 3)
