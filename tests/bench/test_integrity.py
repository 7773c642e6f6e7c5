import json
import math
from argparse import ArgumentParser
from dataclasses import asdict

import numpy as np
import pytest

from bench.harness.rows import upper
from bench.integrity import integrity
from bench.integrity.integrity import Tally, class_table, classes, false_list, family_table, plain, reliability_table
from bench.integrity.kinds import CALIBRATION, REPORTED, draw
from bench.integrity.plan import FAMILIES, plan
from bench.integrity.run import append, judged, mirrored, read, scaled, tilted
from coview_stream.geometry.transforms import pose_from, rot_z


def result(key, outcome, **more):
    said = {"key": key, "code": "a", "kind": "village", "seed": 1, "class": "ordinary", "family": "ordinary village"}
    return said | {"outcome": outcome, "state": "SEARCHING", "metres": 4.0} | more


@pytest.mark.parametrize(
    ("events", "runs", "bound"),
    [(0, 299, 0.00997), (0, 1000, 0.002991), (0, 36, 0.0798), (1, 300, 0.0157), (1, 1000, 0.00474), (5, 5, 1.0)],
)
def test_upper_bound_is_clopper_pearsons(events, runs, bound):
    assert upper(events, runs) == pytest.approx(bound, rel=5e-3)


def test_bound_without_events_is_that_of_the_rule_of_three():
    assert upper(0, 1000) == pytest.approx(1 - 0.05 ** (1 / 1000))


@pytest.mark.parametrize(("events", "runs"), [(1, 20), (7, 20), (19, 20)])
def test_a_bound_leaves_five_percent_of_the_binomial(events, runs):
    def at_most(k, p):
        return sum(math.comb(runs, j) * p**j * (1 - p) ** (runs - j) for j in range(k + 1))

    assert at_most(events, upper(events, runs)) == pytest.approx(0.05)


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
    assert judged(told, truth)["outcome"] == outcome


def test_every_fix_is_false_where_no_pose_is_right():
    assert judged(np.eye(4), None) == {"outcome": "false"}


def test_results_are_found_again_by_key_and_code_the_newest_of_each(tmp_path):
    files = [tmp_path / "a.jsonl", tmp_path / "b.jsonl"]
    append(files[0], result("one", "failed"))
    append(files[0], result("one", "right"))
    append(files[1], result("two", "none", code="b"))
    with files[1].open("a") as stream:
        stream.write(json.dumps(result("three", "none"))[:30])  # as a killed process leaves it
    assert {key: each["outcome"] for key, each in read(files, "a").items()} == {"one": "right"}
    assert set(read([*files, tmp_path / "none.jsonl"], "b")) == {"two"}


def test_failed_runs_and_those_without_a_way_do_not_count():
    runs = [result("1", "right"), result("2", "failed"), result("3", "no way"), result("4", "none", reason="x")]
    tally = Tally.of(runs)
    assert (tally.runs, tally.right, tally.false, tally.searching) == (2, 1, 0, 1)
    assert tally.found == 0.5


def test_ends_without_a_fix_are_told_apart_by_state_and_commonest_reason():
    ends = [("AMBIGUOUS", "two places fit: 1 in 12"), ("AMBIGUOUS", "two places fit: 1 in 9"), ("SEARCHING", "nothing")]
    tally = Tally.of(result(str(k), "none", state=state, reason=said) for k, (state, said) in enumerate(ends))
    assert (tally.ambiguous, tally.searching, tally.reason) == (2, 1, "two places fit: N in N (2)")


def test_numbers_are_left_out_of_reasons():
    assert plain("wrong 1 in 77,000, 0.3 of it") == "wrong N in N, N of it"


def test_shifted_buildings_are_counted_with_the_rest_and_without():
    runs = [result("1", "right"), result("2", "false", **{"class": "near copies", "family": "shifted"})]
    found = classes(runs)
    assert {name: (t.runs, t.false) for name, t in found.items()} == {
        "all": (2, 1), "near copies": (1, 1), "ordinary": (1, 0), "all but shifted buildings": (1, 0)
    }  # fmt: skip
    assert "shifted" in family_table(runs)
    assert "all but shifted buildings" not in classes(runs[:1])


def test_false_first_fixes_are_listed_one_by_one():
    off = {"error_m": 55.0, "error_deg": 1.0, "risk": 3e-5, "sensor": "os64"}
    runs = [result("a", "false", **off), result("b", "right", **off), result("c", "false", risk=0.0, sensor="os64")]
    assert false_list(runs).splitlines() == [
        "- a (os64): after 4 m, 55.0 m, 1.0 degrees off; stated 3.0e-05",
        "- c (os64): after 4 m, no pose is right; stated 0.0e+00",
    ]


def test_a_site_with_two_false_runs_counts_once():
    runs = [result(str(k), "false" if k < 2 else "right", seed=k // 2) for k in range(40)]
    tally = Tally.of(runs)
    assert (tally.false, tally.sites_false, tally.sites) == (2, 1, 20)
    assert tally.site_bound == upper(1, 20) > tally.bound == upper(2, 40)
    cells = [cell.strip() for cell in class_table(runs).splitlines()[2].split("|")]
    assert cells[1:4] == ["all", "40", "20"]
    assert cells[8:10] == ["1", "21.61 %"]


def test_reliability_counts_each_run_once_where_it_first_states_an_error():
    def stated(error, right):
        return {"error": error, "metres": 2.0, "right": right}

    runs = [result(str(k), "right", risk=1e-5, stated={"0.1": stated(0.04, True)}) for k in range(9)]
    runs.append(result("x", "none", stated={"0.1": stated(0.08, False), "0.01": stated(5e-3, True)}))
    runs.append(result("y", "false", risk=5e-3))  # with --risk 0.01: not below 1e-4
    runs.append(result("z", "failed", stated={"0.1": stated(0.01, False)}))
    lines = {line.split("|")[1].strip(): line.split("|")[2:5] for line in reliability_table(runs).splitlines()[2:]}
    counts = {name: (int(cells[0]), cells[1].strip(), int(cells[2])) for name, cells in lines.items()}
    assert counts == {
        "< 0.1": (10, "4.4e-02", 1), "< 0.01": (1, "5.0e-03", 0), "< 0.001": (0, "-", 0), "< 0.0001": (9, "1.0e-05", 0)
    }  # fmt: skip


def every(group, count=1080):
    return [run for site in plan(group, count) for run in site]


def test_the_plan_has_the_runs_that_the_bounds_need_and_fitted_kinds_are_not_reported():
    used = {
        group: {k for run in every(group) for k in (run.kind, run.driven) if k} for group in ("calibration", "reported")
    }
    assert (used["calibration"], used["reported"]) == (CALIBRATION, REPORTED)
    assert not CALIBRATION & REPORTED
    runs = every("reported")
    classes = [run.of_class for run in runs]
    assert len(runs) == len({run.key for run in runs}) == 1080
    assert len({(run.kind, run.seed, run.drive_seed, run.driven) for run in runs}) == 1080
    assert min(classes.count("ordinary"), classes.count("outside")) >= 300
    assert classes.count("near copies") >= 400
    assert {run.family for run in runs} | {run.family for run in every("calibration")} == set(FAMILIES)
    assert {run.family for run in every("reported", 60)} == {run.family for run in runs}


def in_world(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


def test_altered_worlds_are_mirrored_scaled_or_tilted():
    cloud = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    T = pose_from(rot_z(0.6), np.array([5.0, 4.0, 1.5]))
    mirror, larger, tilt = mirrored(), scaled(1.05), tilted(np.radians(3.0), 0.7)
    (turned,) = mirror.poses(T[None])
    np.testing.assert_allclose(in_world(turned, mirror.cloud(cloud)), in_world(T, cloud) * (-1, 1, 1), atol=1e-5)
    assert not mirror.right
    (smaller,) = larger.poses(T[None])
    np.testing.assert_allclose(1.05 * in_world(smaller, larger.cloud(cloud)), in_world(T, cloud), atol=1e-5)
    R = tilt.poses(np.eye(4)[None])[0, :3, :3]
    assert np.degrees(np.arccos(R[2, 2])) == pytest.approx(3.0)


def test_the_survey_is_the_same_whatever_changes_later():
    for kind in ("yard", "rows", "storey", "suburb"):
        before, after = (draw(kind, 6, 200.0, changed) for changed in (0.0, 1.0))
        np.testing.assert_array_equal(before.mapped.solid.vertices, after.mapped.solid.vertices)
        assert before.now.solid.vertices.shape != after.now.solid.vertices.shape or kind == "rows"


@pytest.fixture
def asked(tmp_path, monkeypatch):
    monkeypatch.setenv("COVIEW_BENCH", str(tmp_path))

    def parsed(*words):
        parser = ArgumentParser()
        parser.add_argument("--quick", action="store_true")
        integrity.options(parser)
        return parser.parse_args(["--quick", *words])

    return parsed


@pytest.fixture
def made(monkeypatch):
    """Keys of the runs that were made; those of the family "old" fail."""
    keys = []

    def everywhere(sites, task, jobs):
        for run in (run for site in sites for run in site):
            keys.append(task.key(run))
            outcome = "failed" if run.family == "old" else "none"
            result = {"key": task.key(run), "code": task.code, "class": run.of_class, **asdict(run), "outcome": outcome}
            result |= {"state": "SEARCHING", "reason": "no place", "cost_s": 1.0, "site_s": 2.0}
            append(task.results, result)
            yield result

    monkeypatch.setattr(integrity, "everywhere", everywhere)
    return keys


def test_only_missing_and_failed_runs_are_made_and_shards_share_their_results(asked, made):
    for share in ("1/3", "2/3", "3/3"):
        rows = list(integrity.rows(asked("--shard", share)))
    assert len(made) == len(set(made)) == 60
    assert len(rows[-1].details["results"]) == 60
    failed = [key for key in made if key.endswith("-old")]
    assert [row.holds for row in rows if row.name.endswith("runs that failed")] == [False]
    made.clear()
    list(integrity.rows(asked()))
    assert made == failed
    list(integrity.rows(asked("--risk", "0.1", "--families", "court")))
    assert all(key.endswith("@0.1") for key in made[len(failed) :])


@pytest.mark.parametrize("text", ["0/3", "4/3", "three", "1/0"])
def test_a_wrong_shard_is_refused(asked, text, capsys):
    with pytest.raises(SystemExit):
        asked("--shard", text)
    assert text in capsys.readouterr().err
