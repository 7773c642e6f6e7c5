"""The scenarios of bench.tracking, their worlds, and a small one from end to end."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from bench.tracking.plot import draw
from told import told

from bench.harness.suite import OWN
from bench.harness.worlds import TUNED_SEEDS
from bench.tracking import run as tracking_run
from bench.tracking import tracking
from bench.tracking import worlds as tracking_worlds
from bench.tracking.coverage import pooled
from bench.tracking.scenarios import QUICK, Scenario, scenarios
from bench.tracking.worlds import World, earlier, open_world
from coview_stream.sim.scenes import build_scene


def test_an_earlier_place_has_other_buildings_and_is_driven_through_as_it_is():
    scene = build_scene("town", 1, 90.0, 0.3)
    past = earlier(scene, 1, 0.3)
    assert past.now is scene.mapped
    ground = len(scene.site.mesh().vertices)
    before, after = past.mapped.solid.vertices, scene.now.solid.vertices
    np.testing.assert_array_equal(before[:ground], after[:ground])
    owner = tracking_worlds._owners(scene)
    moved = set(owner[(before != after).any(axis=1)])
    used = np.zeros(len(after), dtype=bool)
    used[past.mapped.solid.triangles] = True
    gone = {k for k in range(len(scene.footprints)) if not used[owner == k].any()}
    assert -1 not in moved
    assert len(moved | gone) == round(0.3 * len(scene.footprints))
    assert len(gone) == -(-len(moved | gone) // 3)


def test_scenarios_are_named_once_and_driven_where_nobody_tunes():
    assert len({s.name for s in scenarios()}) == len(scenarios())
    plain = [s for s in scenarios() if s.plain]
    assert len(plain) == 10
    assert {s.world.kind for s in plain} == {"town", "campus", "sparse-forest"}
    assert {min(s.drift for s in plain), max(s.drift for s in plain)} == {0.005, 0.05}
    assert all(300.0 <= s.world.length <= 600.0 for s in plain)
    seeds = {s.world.seed for s in scenarios()}
    assert seeds == set(range(5001, 5011))
    assert not seeds & TUNED_SEEDS
    assert "tracking" in OWN


def test_a_small_world_is_measured_from_end_to_end(tmp_path, monkeypatch, capsys):
    world = World("sparse-forest", "vlp16", 1, 80.0, 1.0, 2.0, 0.02)
    small = (Scenario("plain/small", world, lambda drive: drive, 0.02),)
    monkeypatch.setattr(tracking, "QUICK", small)
    monkeypatch.setattr(
        tracking_worlds, "_build", lambda file, points: np.save(file.with_suffix(".npy"), points)
    )

    def follow(site, recorded, drive):
        assert np.load(site.with_suffix(".npy")).shape[1] == 3
        assert len(recorded.read(0)) > 1000
        poses = drive.truth.copy()
        poses[:, 0, 3] += 0.15
        return replace(
            told(["TRACKING"] * len(drive), poses, covariance=0.01 * np.eye(6)), stamps=drive.stamps
        )

    monkeypatch.setattr(tracking_run, "follow", follow)
    picture, file = tmp_path / "coverage.png", tmp_path / "rows.json"
    arguments = ["--quick", "--worlds", str(tmp_path), "--plot", str(picture), "--json", str(file)]
    assert tracking.main(arguments) == 1  # 0.15 m is more than a drive may be off
    written = json.loads(file.read_text())
    assert written["rows"][0]["metres"]["rmse"] == pytest.approx(0.15)
    assert picture.stat().st_size > 10_000
    assert "plain/small" in capsys.readouterr().out
    monkeypatch.setattr(tracking_run, "follow", None)  # an unchanged engine is not asked twice
    assert tracking.main(arguments) == 1
    rounded = open_world(tmp_path, world)
    assert np.abs(rounded.read(3)).max() < 131.0


def test_names_pick_scenarios(capsys):
    assert tracking.main(["--list", "kidnap"]) == 0
    assert capsys.readouterr().out.split() == ["kidnap/town", "kidnap/campus", "kidnap/forest"]
    assert tracking.main(["--list", "--quick"]) == 0
    assert capsys.readouterr().out.split() == [s.name for s in QUICK]
    assert tracking.main(["nothing"]) == 2


@pytest.mark.parametrize("option", ["--json", "--plot"])
def test_a_file_that_cannot_be_written_is_noticed_before_the_run(option, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tracking, "_run", None)
    for path in (tmp_path / "nowhere" / "file", tmp_path):
        assert tracking.main(["--quick", option, str(path)]) == 2
        said = capsys.readouterr().err
        assert f"{option} {path}" in said
        assert said.count("\n") == 1


def test_a_picture_without_poses_says_so(tmp_path):
    draw(pooled([]), tmp_path / "empty.png", "nothing")
    assert (tmp_path / "empty.png").stat().st_size > 5000
