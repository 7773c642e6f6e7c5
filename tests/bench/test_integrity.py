import math
from argparse import Namespace
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from bench.harness import files
from bench.harness.files import locked
from bench.harness.rows import informs, upper
from bench.integrity import challenge, integrity, run
from bench.integrity.integrity import RUNS, Tally, chosen, classes, code_of_runs, keep, planned, reliability_table
from bench.integrity.kinds import CALIBRATION, REPORTED, draw
from bench.integrity.plan import FAMILIES, STATED, Run, plan, real_runs
from bench.integrity.run import altered, before, drive_of, judged
from coview_stream.clouds import write_tum
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import pose_from, rot_z


def result(key, outcome, **more):
    said = {"key": key, "code": "a", "kind": "village", "seed": 1, "class": "ordinary", "family": "ordinary village"}
    return said | {"outcome": outcome, "state": "SEARCHING", "metres": 4.0, "searched": []} | more


@pytest.mark.parametrize(
    ("events", "runs", "bound"),
    [(0, 299, 0.00997), (0, 1000, 0.002991), (0, 36, 0.0798), (1, 300, 0.0157), (1, 1000, 0.00474), (5, 5, 1.0)],
)
def test_upper_bound_is_clopper_pearsons(events, runs, bound):
    assert upper(events, runs) == pytest.approx(bound, rel=5e-3)


def test_a_bound_of_nothing_is_one_and_impossible_counts_are_refused():
    assert upper(0, 0) == 1.0
    with pytest.raises(ValueError, match="5 events of 4 runs"):
        upper(5, 4)


@pytest.mark.parametrize(
    ("metres", "degrees", "outcome"),
    [(2.9, 0.0, "right"), (3.1, 0.0, "false"), (0.0, 4.9, "right"), (0.0, 5.1, "false")],
)
def test_a_fix_is_right_within_three_metres_and_five_degrees(metres, degrees, outcome):
    truth = pose_from(rot_z(1.0), np.array([5.0, 6.0, 7.0]))
    told = truth @ pose_from(rot_z(np.radians(degrees)), np.array([metres, 0.0, 0.0]))
    assert (judged(told, truth)["outcome"], judged(told, None)["outcome"]) == (outcome, "false")


def test_failed_runs_and_those_without_a_way_do_not_count_and_those_without_a_fix_by_their_last_state():
    runs = [result("1", "right"), result("2", "failed"), result("3", "no way"), result("4", "none", reason="x")]
    tally = Tally.of([*runs, result("5", "none", state="LOST"), result("6", "none", state="AMBIGUOUS")])
    assert (tally.runs, tally.right, tally.false, tally.ambiguous, tally.searching) == (4, 1, 0, 1, 2)
    assert tally.found == 0.25


def test_shifted_buildings_are_counted_with_the_rest_and_without():
    runs = [result("1", "right"), result("2", "false", **{"class": "near copies", "family": "shifted"})]
    found = classes(runs)
    assert {name: (t.runs, t.false) for name, t in found.items()} == {
        "all": (2, 1), "near copies": (1, 1), "ordinary": (1, 0), "all but shifted buildings": (1, 0)
    }  # fmt: skip
    assert "all but shifted buildings" not in classes(runs[:1])


def test_bounds_are_also_of_the_fixes_and_real_runs_are_apart():
    runs = [*(result(str(k), "none") for k in range(9)), result("a", "right"), result("b", "false")]
    found = classes([*runs, result("r", "right", **{"class": "real run"})])
    assert (found["all"].runs, found["real run"].runs) == (11, 1)
    assert found["all"].fix_bound == upper(1, 2) > found["all"].bound == upper(1, 11)


def test_squares_of_a_survey_in_one_block_are_one_site():
    runs = [result(str(k), "right", seed=k, ground=f"town {k // 5}") for k in range(10)]
    assert Tally.of(runs).sites == 2


def test_each_run_is_searched_as_the_first_one_of_its_map():
    robot = Mock()
    robot.localizer.state.value = "SEARCHING"
    nothing = run.Drive(np.empty((0, 4, 4)), np.empty((0, 4, 4)), None, Mock())
    assert run.first_fix(robot, nothing)["outcome"] == "none"
    robot.localizer.reset.assert_called_once_with()
    robot.search.reset.assert_called_once_with()


def test_a_site_with_two_false_runs_counts_once():
    runs = [result(str(k), "false" if k < 2 else "right", seed=k // 2) for k in range(40)]
    tally = Tally.of(runs)
    assert (tally.false, tally.sites_false, tally.sites) == (2, 1, 20)
    assert tally.site_bound == upper(1, 20) > tally.bound == upper(2, 40)


def search(*keyframes):
    return [(2.0 * k, *keyframe) for k, keyframe in enumerate(keyframes)]


def test_reliability_counts_each_run_once_where_it_first_states_an_error():
    sure = search((0.2, True), (0.04, True), (0.02, False))
    runs = [result(str(k), "right", searched=sure) for k in range(9)]
    runs.append(result("x", "none", searched=search((0.08, False), (5e-3, True))))
    runs.append(result("s", "none", family="survey shifted", searched=search((5e-3, False))))
    mirrored = {"class": FAMILIES["mirrored"], "family": "mirrored"}
    runs.append(result("y", "none", **mirrored, searched=search((0.9, False), (5e-5, False))))
    runs.append(result("w", "none", **{"class": "outside"}, searched=search((0.9, False))))
    runs.append(result("z", "failed", searched=search((0.01, False))))
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in reliability_table(runs).splitlines()[2:]]
    found = {(part, limit): cells for part, limit, *cells in lines}
    assert {key[1]: (cells[1], cells[5]) for key, cells in found.items() if key[0] == "ordinary"} == {
        "< 0.1": ("1 of 10", "2.0, 2.0"), "< 0.01": ("0 of 1", "2.0, 2.0"), "< 0.001": ("0 of 0", "-"),
        "< 0.0001": ("0 of 0", "-"),
    }  # fmt: skip
    assert found["ordinary", "< 0.1"][0] == "4.4e-02"
    assert found["ordinary", "< 0.1"][4] == "1 of 1: 0.03 to 1"  # all on one map
    assert [found["shifted", f"< {limit:g}"][1] for limit in STATED] == ["1 of 1", "1 of 1", "0 of 0", "0 of 0"]
    assert {found["no place is right", f"< {limit:g}"][1] for limit in STATED} == {"1 of 2"}


def every(group, count=1080):
    return [run for site in plan(group, count) for run in site]


def test_the_plan_has_the_runs_that_the_bounds_need_and_fitted_kinds_are_not_reported():
    used = {
        group: {k for run in every(group) for k in (run.kind, run.driven) if k} for group in ("calibration", "reported")
    }
    assert (used["calibration"], used["reported"]) == (CALIBRATION, REPORTED)
    assert not CALIBRATION & REPORTED
    runs = every("reported")
    classes = [FAMILIES[run.family] for run in runs]
    assert len(runs) == len({run.key for run in runs}) == 1080
    assert len({(run.kind, run.seed, run.drive_seed, run.driven) for run in runs}) == 1080
    assert min(classes.count("ordinary"), classes.count("outside")) >= 300
    assert classes.count("near copies") >= 380  # with those of the surveys: below
    real = every("surveys", 30)
    recorded = real_runs(["a", "b"])
    assert {run.family for run in (*runs, *real, *every("calibration"), *recorded[0])} == set(FAMILIES)
    assert {run.family for run in every("reported", 60)} == {run.family for run in runs}


def test_half_of_the_3000_runs_are_on_real_surveys_and_900_near_copies_and_900_outside(tmp_path, monkeypatch):
    monkeypatch.setenv("COVIEW_DATA", str(tmp_path))
    for file in ("surveys/town.laz", "drive/base.laz"):
        (tmp_path / file).parent.mkdir()
        (tmp_path / file).touch()
    runs = [run for site in planned(RUNS) for run in site]
    assert [run.kind for run in runs if run.group == "runs"] == ["drive"] * 8
    runs = [run for run in runs if run.group != "runs"]
    assert len({run.key for run in runs}) == len(runs) == RUNS
    assert sum(run.group == "surveys" for run in runs) == RUNS / 2
    classes = [FAMILIES[run.family] for run in runs]
    assert min(classes.count("near copies"), classes.count("outside")) >= 900
    assert all(upper(0, classes.count(name)) <= most for name, most in integrity.MOST.items() if name in classes)
    assert upper(0, sum(not run.family.endswith("shifted") for run in runs)) < 1e-3


ALTERED = (("mirrored", 0.0), ("scaled", 1.0), ("tilted", 0.5))  # by 5 %, by 3 degrees


def in_world(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


def test_altered_worlds_are_mirrored_scaled_or_tilted():
    cloud = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    T = pose_from(rot_z(0.6), np.array([5.0, 4.0, 1.5]))
    mirror, larger, tilt = (altered(family, 1.0, share, 0.7) for family, share in ALTERED)
    (turned,) = mirror.poses(T[None])
    np.testing.assert_allclose(in_world(turned, mirror.cloud(cloud)), in_world(T, cloud) * (-1, 1, 1), atol=1e-5)
    (smaller,) = larger.poses(T[None])
    np.testing.assert_allclose(1.05 * in_world(smaller, larger.cloud(cloud)), in_world(T, cloud), atol=1e-5)
    R = tilt.poses(np.eye(4)[None])[0, :3, :3]
    assert np.degrees(np.arccos(R[2, 2])) == pytest.approx(3.0)


@pytest.mark.slow
def test_no_pose_is_right_in_a_mirrored_world_or_on_the_map_of_another_site():
    run = Run("reported", "ordinary village", "yard", 6, 0, "vlp16")
    cases = (run, replace(run, family="mirrored"), replace(run, driven="rows"))
    assert [drive_of(case).truth is None for case in cases] == [False, True, True]


@pytest.mark.slow
def test_the_survey_is_the_same_whatever_changes_later():
    for kind in ("yard", "rows", "suburb"):
        before, after = (draw(kind, 6, changed) for changed in (0.0, 1.0))
        np.testing.assert_array_equal(before.mapped.solid.vertices, after.mapped.solid.vertices)
        assert before.now.solid.vertices.shape != after.now.solid.vertices.shape or kind == "rows"


def test_a_site_without_a_map_costs_its_runs_and_is_made_again_by_one_process_in_time(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(run, "map_of", lambda case: calls.append(case) or 1 / 0)
    site = plan("reported", 2)[0]
    below = tmp_path / "integrity"
    assert run.on_site(site, below, "a", until=0.0) == ([], False)
    with locked(tmp_path / f"integrity-{site[0].kind}-{site[0].seed}.lock"):  # another process makes it
        assert run.on_site(site, below, "a") == ([], False)
    assert not calls
    for _ in range(2):
        results, new = run.on_site(site, below, "a")
        assert new
        assert [each["reason"].partition(":")[0] for each in results] == ["ZeroDivisionError"] * 2
        assert Tally.of(results).runs == 0
    assert calls == [site[0]] * 2
    assert not list(tmp_path.rglob("*.lock"))


def test_kept_runs_are_not_made_again_and_those_of_other_code_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("COVIEW_DATA", str(tmp_path))
    kept, searched = tmp_path / "kept.jsonl.xz", [[0.0, 0.02, False]]
    found = {"outcome": "right", "state": "TRACKING", "metres": 4.0, "frames": 6, "searched": searched}
    results = [before(case) | found for site in plan("reported", 10) for case in site]
    asked = Namespace(count=10, families=None, minutes=math.inf, jobs=1, kept=kept)
    for some in (results[:8], results[8:]):
        keep(kept, code_of_runs(), some)
    made = [informs("x", 10, "", {"results": results})]
    assert integrity.tables(list(integrity.rows(asked)), asked) == integrity.tables(made, asked)
    kept.unlink()
    keep(kept, "other", results)
    with pytest.raises(InputError, match=r"kept.jsonl.xz: of .*'other'"):
        list(integrity.rows(asked))


def test_runs_are_chosen_by_family_and_an_unknown_one_is_refused():
    sites = plan("reported", 60)
    assert {run.family for site in chosen(sites, "court, old") for run in site} == {"court", "old"}
    assert chosen(sites, None) == sites
    with pytest.raises(InputError, match="--families nowhere"):
        chosen(sites, "nowhere")


def test_an_answer_to_the_challenge_is_its_first_line(tmp_path):
    truth, answer, nowhere = (tmp_path / f"{name}.tum" for name in ("truth", "answer", "nowhere"))
    poses = np.array([pose_from(np.eye(3), [2.0 * k, 0.0, 0.0]) for k in range(5)])
    write_tum(truth, np.arange(5.0), poses)
    write_tum(nowhere, [], [])
    assert challenge.score(answer, truth)["outcome"] == "failed"  # an empty file says that there is no fix
    write_tum(answer, [], [])
    assert challenge.score(answer, truth)["outcome"] == "none"
    write_tum(answer, [2.0, 3.0], poses[[3, 0]])  # 2 m off; the second line would be false
    assert challenge.score(answer, truth) == {"outcome": "right", "metres": 4.0}
    assert challenge.score(answer, nowhere)["outcome"] == "false"
    write_tum(answer, [2.0], poses[[4]])
    assert challenge.score(answer, truth)["outcome"] == "false"
    write_tum(answer, [20.0], poses[[4]])  # of no frame
    assert challenge.score(answer, truth)["outcome"] == "false"


@pytest.mark.parametrize(("code", "writes"), [(0, False), (1, False), (2, True)])
def test_a_command_that_ends_in_a_traceback_has_failed_and_has_not_said_that_there_is_no_fix(
    tmp_path, monkeypatch, code, writes
):
    def command(*words, threads):
        if writes:
            (tmp_path / "trajectory.tum").touch()
        return SimpleNamespace(returncode=code, stderr="Traceback\nValueError: x\n")

    monkeypatch.setattr(files, "command", command)
    with pytest.raises(InputError, match=": ValueError: x"):
        files.trajectory(tmp_path / "site.coview", tmp_path / "run", tmp_path)


def test_runs_depend_on_what_they_execute_and_not_on_commands_or_nodes():
    parts = integrity.parts_of_runs()
    assert {"coview_kernels", "coview_stream/localization/search/scoring.py", "bench/integrity/run.py"} <= set(parts)
    assert not [part for part in parts if part.split("/")[1:2] in (["cli"], ["doctor"], ["stream"], ["viewers"])]
