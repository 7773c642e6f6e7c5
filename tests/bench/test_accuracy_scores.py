"""Verdicts and totals of the accuracy benchmarks judge as they say."""

from dataclasses import replace

import numpy as np
import pytest

from bench.accuracy import ablation, accuracy
from bench.accuracy.stages import Seen, Variant, right
from bench.harness.files import fingerprint, remembered
from bench.harness.worlds import KINDS, LIDARS, TUNED_SEEDS
from bench.tracking.scenarios import scenarios
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.sim import SimulationConfig

TINY = SimulationConfig("town", "os64", seed=1, size=120.0, length=9.0, density=10.0)


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
    return {row.name.partition("/")[2] for row in accuracy.verdicts(rows) if not row.holds}


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
    assert [run == site for run, site in accuracy.pairs(quick=True)] == [True] * 4 + [False] * 2
    pairs = [*accuracy.pairs(), *accuracy.pairs(quick=True)]
    assert sum(run != site for run, site in pairs) >= 10
    for run, site in pairs:
        assert run.scene == site.scene
        assert (run.seed == site.seed) == (run == site)


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
        ([made_up(first_fix_m=None), outside()], {"median first fix"}),
        ([made_up(), outside(posed=1, success=False)], {"outside: poses"}),
        ([made_up(), outside(error="KilledWorker", success=False)], {"outside: poses"}),
        ([made_up(megabytes=1600.0), outside()], {"peak memory of locate"}),
    ],
)
def test_each_target_can_be_missed(rows, what):
    assert missed(rows) == what


def test_a_crash_costs_one_row(tmp_path):
    def crash(work, *args):
        raise MemoryError("too large")

    row = accuracy.run_one(tmp_path, TINY, TINY, crash)
    assert row["error"] == "MemoryError: too large"
    assert "runs localised" in missed([row])
    assert len(accuracy.cells(row)) == len(accuracy.cells(made_up()))


@pytest.mark.parametrize(
    ("shift", "degrees", "verdict"), [(2.9, 8.9, True), (3.1, 0.0, False), (0.0, 9.1, False), (0.0, -8.9, True)]
)
def test_a_place_is_right_within_three_metres_and_nine_degrees(shift, degrees, verdict):
    position = np.array([12.0, -5.0, 1.5])
    seen = Seen(np.zeros((0, 3), np.float32), position, 0.0, pose_from(rot_z(1.0), [100.0, 50.0, 3.0]))
    about = pose_from(rot_z(np.radians(degrees)), position + np.array([0.0, shift, 7.0]))
    T = seen.T_map_odom @ about @ pose_from(np.eye(3), -position)
    assert right(T, seen) is verdict


def test_ablation_totals_count_runs_without_a_fix():
    errors = {"mean": 0.02}
    got = {"keyframes": 4, "top1": 3, "windows": 0, "coarse": 0, "success": True, "false_frames": 0, "posed": 5}
    found = got | {"translation": errors, "rotation": errors, "first_fix_m": 4.0}
    lost = got | {"success": False, "posed": 0, "top1": 0, "translation": None, "rotation": None, "first_fix_m": None}
    row = ablation.total("a", [found, lost, lost])
    assert row.ours == 25.0
    assert row.details["cells"] == ["0.25", "-", "1 of 3", "0 of 5", "0.020", "0.020", "-"]


def test_variants_differ_from_the_default_and_from_each_other():
    unnamed = {replace(variant, name="") for variant in ablation.VARIANTS}
    assert len(unnamed) == len({variant.name for variant in ablation.VARIANTS}) == len(ablation.VARIANTS)
    assert ablation.VARIANTS[0] == Variant(ablation.VARIANTS[0].name)


def test_tracking_seeds_are_not_those_of_tuning():
    assert len({each.name for each in scenarios()}) == len(scenarios())
    assert {each.world.seed for each in scenarios()} == set(range(5001, 5011))
    assert not TUNED_SEEDS & {each.world.seed for each in scenarios()}
