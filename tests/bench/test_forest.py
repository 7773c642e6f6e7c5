"""Scores of the forest benchmarks follow from planted answers; sets of others are read with care."""

import pickle

import numpy as np
import pytest
from drives_with_truth import track

from bench.forest import runs
from bench.forest.forest import METHODS, STEPS, distinct, false, metric_table, recall, success
from bench.forest.recognition import rank, read_sites, recalls
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import pose_from


def answer(off, **more):
    """One planted answer: all methods named places so far off."""
    planted = {
        "world": "w", "kind": "forest rows dense steep leaf-off column", "sensor": "vlp16", "chance": 0.01,
        "off": dict.fromkeys(METHODS, off), "before": [0.5, 1.0],
        "after": [0.1, 0.2], "passes": True, "found": [0.1, 0.2], "ms": dict.fromkeys(STEPS, 10.0), "first": False,
    }  # fmt: skip
    return planted | more


def test_recall_counts_the_best_and_the_best_five():
    answers = [answer([3.0, 50.0]), answer([50.0, 9.9]), answer([10.0, 10.1, 80.0]), answer([])]
    assert (recall(answers, "dense", 1), recall(answers, "dense", 5)) == (0.25, 0.5)


def test_metric_success_needs_both_metres_and_degrees_and_a_wrong_pose_that_passes_is_false():
    answers = [
        answer([1.0], after=[0.3, 1.0]),
        answer([1.0], after=[0.31, 0.1]),
        answer([1.0], after=[0.1, 1.1]),
        answer([1.0], after=None, passes=False, found=None),
    ]
    assert (success(answers, "after", 0.3, 1.0), success(answers, "after", 2.0, 5.0)) == (0.25, 0.75)
    (line,) = [row for row in metric_table(answers).splitlines() if row.startswith("| all ")]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[1:] == ["4", "0.50", "1.0", "100", "0.300", "1.00", "25", "75", "0", "3", "0"]
    wrong = [answer([40.0], after=[40.0, 0.1]), answer([1.0], after=[0.1, 6.0])]
    right = [answer([1.0], after=[1.9, 4.9]), answer([40.0], after=[40.0, 90.0], passes=False)]
    assert [false(each) for each in wrong + right] == [True, True, False, False]


def test_places_are_ten_metres_apart_and_best_first():
    xy = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 11.0], [50.0, 0.0], [80.0, 0.0]])
    score = np.array([1.0, 0.9, 0.5, 0.8, -np.inf])
    np.testing.assert_array_equal(distinct(xy, score), [[0.0, 0.0], [50.0, 0.0], [0.0, 11.0]])


def test_a_run_is_scored_by_two_metres_and_outside_every_pose_is_false():
    truth = np.array([pose_from(np.eye(3), [10.0 * k, 0, 0]) for k in range(5)])
    poses = truth.copy()
    poses[:, 0, 3] += [0.0, 0.3, 0.0, 2.5, 0.4]
    drive = track(["SEARCHING", "TRACKING", "SEARCHING", "TRACKING", "TRACKING"], poses)
    row = runs.scored(drive, truth, outside=False)
    assert (row["driven_m"], row["first_fix_m"], row["posed"], row["false"]) == (40.0, 10.0, 0.6, 1)
    assert row["rmse_m"] == pytest.approx(np.sqrt((0.09 + 0.16) / 2))
    assert runs.scored(drive, truth, outside=True)["false"] == 3


def test_ranks_and_recalls():
    distance = np.array([0.4, 0.1, 0.3, 0.2], np.float32)
    assert (rank(distance, [1]), rank(distance, [0, 2]), rank(np.ones(4, np.float32), [2])) == (1, 3, 4)
    found = recalls(np.array([1, 2, 5, 10]), 300)
    assert found == pytest.approx({"AR@1": 25.0, "AR@5": 75.0, "AR@1 %": 50.0, "MRR": 45.0})


class Harmful:
    def __reduce__(self):
        return (print, ("run",))


def test_nothing_in_a_pickle_is_run(tmp_path, capsys):
    for name in ("database", "query"):
        (tmp_path / f"umd_evaluation_{name}.pickle").write_bytes(pickle.dumps([{0: Harmful()}]))
    with pytest.raises(InputError, match="no plain data"):
        read_sites(tmp_path)
    assert "run" not in capsys.readouterr().out


def test_submaps_of_a_traverse_are_right_within_metres(tmp_path):
    for name, y in (("01", 0.0), ("02", 1.0)):
        (tmp_path / "Tiny" / name / "Clouds").mkdir(parents=True)
        lines = [f"{k},{20.0 * k},{y},0,0,0,0,1" for k in range(5)]
        head = "timestamp,x,y,z,qx,qy,qz,qw"
        (tmp_path / "Tiny" / name / "poses.csv").write_text("\n".join([head, *lines, ""]))
    (site,) = read_sites(tmp_path)
    assert site.pairs() == [(0, 1), (1, 0)]
    assert site.right(0, 1, 3) == [3]
    assert read_sites(tmp_path, within=30.0)[0].right(0, 1, 3) == [2, 3, 4]
