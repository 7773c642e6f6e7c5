"""The bench of airborne-like maps: clouds are made once, and a line says what came of a run."""

from __future__ import annotations

import numpy as np
import pytest

from bench.accuracy.airborne_real import airborne, cells
from bench.accuracy.real_runs import RealSet
from coview_stream.clouds import read_cloud, write_cloud


@pytest.fixture
def street(tmp_path, monkeypatch):
    monkeypatch.setenv("COVIEW_BENCH", str(tmp_path / "work"))
    rng = np.random.default_rng(0)
    ground = rng.uniform([-20.0, -20.0, 0.0], [20.0, 20.0, 0.02], (40_000, 3))
    wall = rng.uniform([-15.0, 4.0, 0.0], [15.0, 4.02, 6.0], (10_000, 3))
    (tmp_path / "street").mkdir()
    write_cloud(tmp_path / "street" / "base.laz", np.concatenate([ground, wall]))
    return RealSet(tmp_path / "street")


def test_a_cloud_is_made_once_and_has_no_walls(street):
    file, facts = airborne(street, 4.0)
    assert len(read_cloud(file)) == facts["kept"] < facts["points"] == 50_000
    assert facts["walls"] < 1.0 < 5.0 < facts["walls_before"]
    made = file.stat().st_mtime_ns
    assert airborne(street, 4.0) == (file, facts)
    assert file.stat().st_mtime_ns == made
    assert airborne(street, 8.0)[0] != file


def test_a_line_of_the_table():
    none = dict.fromkeys(("first_fix_m", "first_m", "first_deg", "rmse_m", "rmse_deg", "max_m", "max_deg"))
    scores = {"set": "hall", "condition": "base", "frames": 44, "posed": 0, "false_frames": 0, **none}
    assert cells({**scores, "density": None})[2:7] == ["ground survey", "-", "-", "44", "0"]
    shown = cells({**scores, "density": 8.0, "points": 200, "kept": 50, "walls": 0.2})
    assert shown[2:5] == ["8", "25", "0.2"]
    assert shown[-1] == "0"
