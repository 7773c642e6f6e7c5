"""The benchmarks judge as they say; on one tiny world they do so from end to end."""

from dataclasses import replace

import numpy as np
import pytest

from bench.accuracy import ablation, accuracy
from bench.accuracy.stages import Bank, Seen, Variant, keyframes_of, right
from bench.harness import worlds
from bench.harness.worlds import KINDS, LIDARS, TUNED_SEEDS, fingerprint, map_of, remembered, world_name
from bench.speed import build_map
from coview_stream.clouds import write_cloud
from coview_stream.config import DescriptorConfig
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.sim import SimulationConfig

TINY = SimulationConfig("town", "os64", seed=1, size=120.0, length=9.0, density=10.0)
ELSEWHERE = SimulationConfig("town", "os64", seed=2, size=90.0, length=0.0, density=5.0)


def here(work, *args):
    return work(*args)


def never(work, *args):
    raise AssertionError(f"{work} was called again")


@pytest.fixture(autouse=True, scope="module")
def _same_code():
    """Whoever edits the sources while the tests run shall not make them simulate everything again."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (accuracy, ablation, worlds):
            patch.setattr(module, "fingerprint", lambda *parts: "code")
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("worlds")


@pytest.fixture(scope="module")
def row(folder):
    return accuracy.run_one(folder, TINY, TINY, here)


def made_up(**changes):
    errors = {"mean": 0.02, "rmse": 0.02, "median": 0.02, "max": 0.05}
    row = {
        "name": "town-os64-1", "run": TINY.to_dict(), "outside": False, "code": "x", "state": "TRACKING",
        "reason": "", "frames": 10, "posed": 9, "success": True, "false_frames": 0, "first_fix_m": 4.0,
        "translation": errors, "rotation": errors, "megabytes": 500.0,
    }  # fmt: skip
    return row | changes


def outside(**changes):
    return made_up(outside=True, posed=0, translation=None, rotation=None) | changes


def missed(rows):
    return {what for what, *_, met in accuracy.verdicts(rows) if not met}


def test_held_out_worlds_are_many_varied_and_apart_from_what_was_tuned_on():
    worlds = accuracy.held_out_worlds()
    seeds = {world.seed for world in worlds}
    assert len(seeds) == 24
    assert not seeds & (TUNED_SEEDS | set(ablation.SEEDS))
    assert not TUNED_SEEDS & set(ablation.SEEDS)
    assert {(world.scene, world.sensor) for world in worlds} == {(k, s) for k in KINDS for s in LIDARS}
    assert {min(w.size for w in worlds), max(w.size for w in worlds)} == {240.0, 600.0}
    assert {min(w.length for w in worlds), max(w.length for w in worlds)} == {40.0, 120.0}
    assert sum(world.changed >= 0.2 for world in worlds) >= 8
    assert sum(any(world.origin) for world in worlds) >= 8


def test_outside_runs_are_on_the_map_of_another_world_of_the_same_kind():
    worlds = accuracy.held_out_worlds()
    few, strangers = accuracy.quick(worlds)
    assert len(few) == 4
    pairs = accuracy.outside_pairs(worlds)
    assert len(pairs) >= 8
    for run, site in [*pairs, *strangers]:
        assert run.scene == site.scene
        assert run.seed != site.seed


def test_a_result_is_reused_for_the_same_spec_only(tmp_path):
    file = tmp_path / "deep" / "result.json"
    assert remembered(file, {"code": "a", "size": (1, 2)}, lambda: {"value": 1}) == {"value": 1}
    assert remembered(file, {"code": "a", "size": (1, 2)}, lambda: {"value": 2}) == {"value": 1}
    assert remembered(file, {"code": "b", "size": (1, 2)}, lambda: {"value": 3}) == {"value": 3}


def test_fingerprints_tell_sources_apart():
    parts = ("coview_stream/sim", "coview_stream/descriptors/coview.py", "coview_kernels", "")
    assert len({fingerprint(part) if part else fingerprint() for part in parts}) == len(parts)


@pytest.mark.parametrize(
    ("rows", "what"),
    [
        ([made_up(), outside()], set()),
        ([made_up(success=False), outside()], {"runs localised"}),
        ([made_up(false_frames=1), outside()], {"false frames"}),
        ([made_up(translation={"mean": 0.09}), outside()], {"mean translation error, m"}),
        ([made_up(rotation={"mean": 0.31}), outside()], {"mean rotation error, deg"}),
        ([made_up(first_fix_m=None), outside()], {"median first fix, m"}),
        ([made_up(), outside(posed=1, success=False)], {"outside: poses"}),
        ([made_up(), outside(error="KilledWorker", success=False)], {"outside: poses"}),
        ([made_up(megabytes=1600.0), outside()], {"peak memory of locate, MB"}),
    ],
)
def test_each_target_can_be_missed(rows, what):
    assert missed(rows) == what


def test_accuracy_says_what_was_missed_in_its_exit_code_and_text(monkeypatch, capsys, tmp_path):
    def run_one(folder, run, site):
        return made_up() if run == site else outside(posed=3, success=False, name="stray")

    monkeypatch.setattr(accuracy, "run_one", run_one)
    assert accuracy.main(["--quick", "--worlds", str(tmp_path), "--json", str(tmp_path / "a.json")]) == 1
    printed = capsys.readouterr().out
    assert "6 in 2 runs" in printed
    assert "MISSED" in printed
    assert "- stray: TRACKING, 3 poses" in printed
    assert '"met": false' in (tmp_path / "a.json").read_text()


def test_a_crash_costs_one_row(tmp_path):
    def crash(work, *args):
        raise MemoryError("too large")

    row = accuracy.run_one(tmp_path, TINY, TINY, crash)
    assert row["error"] == "MemoryError: too large"
    assert "runs localised" in missed([row])
    assert len(accuracy.cells(row)) == len(accuracy.cells(made_up()))
    assert "MemoryError" in accuracy.summary([row])


def test_a_tiny_world_is_localised_and_the_result_kept(folder, row):
    assert row["success"] is True
    assert row["false_frames"] == 0
    assert not row["outside"]
    assert row["translation"]["mean"] < accuracy.MOST_TRANSLATION
    assert row["frames"] == int(TINY.length / (TINY.speed * 0.1)) + 1
    assert accuracy.run_one(folder, TINY, TINY, never) == row


def test_a_run_elsewhere_is_judged_by_its_poses(folder, row):
    stray = accuracy.run_one(folder, TINY, ELSEWHERE, here)
    assert stray["outside"]
    assert stray["posed"] == stray["false_frames"] == 0
    assert missed([row, stray]) == missed([row])


def test_describing_again_gives_what_the_map_was_built_with(folder, row):
    bank = Bank(map_of(folder, TINY))
    config = bank.built.descriptor_config
    again = bank.map(config)
    for name in config.channels:
        np.testing.assert_array_equal(again.descriptors(name), bank.built.descriptors(name))
    strict = bank.map(DescriptorConfig(channels=("coview_strict",)))
    assert strict.descriptor_config.channels == ("coview_strict",)
    assert np.any(strict.descriptors("coview_strict") != bank.built.descriptors("coview"))


def test_keyframes_come_with_their_true_place(folder, row):
    bank = Bank(map_of(folder, TINY))
    seen = list(keyframes_of(folder / world_name(TINY), bank.built.origin, bank.built.descriptor_config))
    assert len(seen) == 5
    for keyframe in seen:
        on_map = keyframe.T_map_odom[:3, :3] @ keyframe.position + keyframe.T_map_odom[:3, 3]
        nearest = bank.built.stations[np.hypot(*(bank.built.stations[:, :2] - on_map[:2]).T).argmin()]
        assert on_map[2] - nearest[2] == pytest.approx(TINY.height, abs=0.3)
        assert keyframe.position[2] - keyframe.ground == pytest.approx(TINY.height, abs=0.3)


@pytest.mark.parametrize(
    ("shift", "degrees", "verdict"),
    [(2.9, 8.9, True), (3.1, 0.0, False), (0.0, 9.1, False), (0.0, -8.9, True)],
)
def test_a_place_is_right_within_three_metres_and_nine_degrees(shift, degrees, verdict):
    position = np.array([12.0, -5.0, 1.5])
    seen = Seen(np.zeros((0, 3), np.float32), position, 0.0, pose_from(rot_z(1.0), [100.0, 50.0, 3.0]))
    about = pose_from(rot_z(np.radians(degrees)), position + np.array([0.0, shift, 7.0]))
    T = seen.T_map_odom @ about @ pose_from(np.eye(3), -position)
    assert right(T, seen) is verdict


def test_the_ablation_of_a_tiny_world(folder, row):
    names = [ablation.VARIANTS[0].name, "co-view alone, zero at the sensor"]
    measured, code = ablation.measure(folder, TINY, names, here)
    for name in names:
        got = measured[name]
        assert (got["keyframes"], got["windows"]) == (5, 1)
        assert 0 <= got["top1"] <= 5
        assert got["false_frames"] == 0
    assert measured[names[0]]["top1"] >= 4
    assert measured[names[0]]["coarse"] == 1
    assert measured[names[0]]["success"] is True
    assert ablation.measure(folder, TINY, names, never) == (measured, code)
    text = ablation.report({1: measured, 2101: measured}, names, 11.0, code)
    held_out, tuned = text.split("TUNED")
    assert all(name in held_out and name in tuned for name in names)


def test_ablation_totals_count_runs_without_a_fix():
    errors = {"mean": 0.02}
    got = {
        "keyframes": 4,
        "top1": 3,
        "windows": 0,
        "coarse": 0,
        "success": True,
        "false_frames": 0,
        "posed": 5,
    }
    found = got | {"translation": errors, "rotation": errors, "first_fix_m": 4.0}
    lost = got | {
        "success": False,
        "posed": 0,
        "top1": 0,
        "translation": None,
        "rotation": None,
        "first_fix_m": None,
    }
    (cells,) = ablation.aggregate([{"a": found}, {"a": lost}, {"a": lost}], ["a"])
    assert cells == ["a", "0.25", "-", "1 of 3", "0 of 5", "0.020", "0.020", "-"]


def test_variants_differ_from_the_default_and_from_each_other():
    unnamed = {replace(variant, name="") for variant in ablation.VARIANTS}
    assert len(unnamed) == len({variant.name for variant in ablation.VARIANTS}) == len(ablation.VARIANTS)
    assert ablation.VARIANTS[0] == Variant(ablation.VARIANTS[0].name)


def test_the_synthetic_map_has_its_points_and_room_for_its_stations(tmp_path):
    cloud = build_map.synthetic(120_000, 400, 2.0)
    assert len(cloud) == pytest.approx(120_000, rel=0.01)
    write_cloud(tmp_path / "s.laz", cloud)
    found = build_map.build([tmp_path / "s.laz"], tmp_path / "s.coview", 2.0)
    assert found["stations"] >= 400
    assert found["source_points"] == len(cloud)
    assert sum(found["stages"].values()) <= found["seconds"]
    assert "met" in build_map.report(found | {"seconds": 1.0, "megabytes": 1.0})
    assert "MISSED" in build_map.report(found | {"seconds": 1.0, "megabytes": 5000.0})
