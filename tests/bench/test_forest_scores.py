"""Scores of the forest benchmarks follow from planted results."""

import numpy as np
import pytest
from told import told

from bench.forest import runs
from bench.forest.methods import BASELINES, METHODS
from bench.forest.query import distinct, errors, query_of
from bench.forest.tables import (
    STEPS,
    compared_table,
    false,
    groups,
    metric_table,
    recall,
    recall_table,
    success,
    tables,
    times_table,
)
from bench.forest.worlds import Drive, in_odometry
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import pose_from, rot_z


def answer(off, kind="forest rows dense steep leaf-off column", sensor="vlp16", **more):
    """One planted answer: all methods named places so far off."""
    return {
        "world": "w",
        "kind": kind,
        "sensor": sensor,
        "travelled": 10.0,
        "chance": 0.01,
        "off": dict.fromkeys(METHODS, off),
        "chains": dict.fromkeys(BASELINES, chain([6.0, 2.0], [4.0, 3.0])),
        "before": [0.5, 1.0],
        "after": [0.1, 0.2],
        "passes": True,
        "found": [0.1, 0.2],
        "ms": dict.fromkeys(STEPS, 10.0),
        "first": False,
        **more,
    }


def chain(before, after, believed=True):
    """What one method's places were registered to."""
    return {"before": before, "after": after, "score": 0.5, "passes": believed, "ms": 80.0}


def cells(text, row):
    """Cells of the row of a table that begins with a word."""
    found = [line for line in text.splitlines() if line.startswith(f"| {row} ")]
    assert len(found) == 1, text
    return [cell.strip() for cell in found[0].strip("|").split("|")]


def test_recall_counts_the_best_and_the_best_five():
    answers = [answer([3.0, 50.0]), answer([50.0, 9.9]), answer([10.0, 10.1, 80.0]), answer([])]
    assert recall(answers, "dense", 1) == 0.25
    assert recall(answers, "dense", 5) == 0.5
    row = cells(recall_table(answers), "all")
    assert row == ["all", "4", "1.0", *["25 / 50"] * len(METHODS)]


def test_queries_are_grouped_by_sensor_season_density_and_kind():
    answers = [
        answer([3.0]),
        answer([3.0], kind="forest random sparse flat leaf-on cone", sensor="os64"),
        answer([3.0], kind="town", sensor="os64"),
        answer([3.0], kind="on disk", sensor="unknown"),
    ]
    sizes = {name: len(some) for name, some in groups(answers)}
    assert sizes == {
        "all": 4, "os64": 2, "unknown": 1, "vlp16": 1, "forest": 2, "forest, sparse": 1, "forest, dense": 1,
        "forest, flat": 1, "forest, steep": 1, "forest, leaf-on": 1, "forest, leaf-off": 1, "built": 1, "on disk": 1,
    }  # fmt: skip


def test_metric_success_needs_both_metres_and_degrees():
    answers = [
        answer([1.0], after=[0.3, 1.0]),
        answer([1.0], after=[0.31, 0.1]),
        answer([1.0], after=[0.1, 1.1]),
        answer([1.0], after=None, passes=False, found=None),
    ]
    assert success(answers, "after", 0.3, 1.0) == 0.25
    assert success(answers, "after", 2.0, 5.0) == 0.75
    row = cells(metric_table(answers), "all")
    assert row[1:] == ["4", "0.50", "1.0", "100", "0.300", "1.00", "25", "75", "0", "3", "0"]


def test_every_methods_places_are_registered_and_judged_alike():
    poor = {name: chain([9.0, 20.0], None, believed=False) for name in BASELINES}
    poor["both"] = chain([1.0, 2.0], [0.2, 0.9])
    answers = [answer([1.0]), answer([1.0], chains=poor), answer([1.0], kind="town", chains=poor)]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in compared_table(answers).splitlines()[2:]]
    assert [line[:3] for line in lines[:5]] == [["all", "3", name] for name in (*BASELINES, "learned")]
    assert {line[0] for line in lines} == {"all", "forest", "built"}
    assert len(compared_table(answers[:2]).splitlines()) == 2 + 5  # all are forests: once is enough
    of = {line[2]: line[3:] for line in lines[:5]}
    # one pose only, believed and 4 m off; two queries without any
    assert of["canopy"] == ["9.00", "20.0", "0", "4.000", "3.00", "0", "0", "1", "80"]
    assert of["both"] == ["1.00", "2.0", "67", "0.200", "0.90", "67", "67", "1", "80"]
    assert of["learned"] == ["0.50", "1.0", "100", "0.100", "0.20", "100", "100", "0", "10"]


def test_worlds_on_disk_alone_have_tables_of_their_own():
    planted = answer([3.0], kind="on disk")
    assert set(tables([planted])) == {f"disk {name}" for name in ("recall", "metric", "compared")}
    assert set(tables([planted, answer([3.0])])) == {
        "recall", "metric", "compared", "times",
    }  # fmt: skip


def test_wrong_pose_that_passes_is_counted_as_false():
    wrong = [answer([40.0], after=[40.0, 0.1]), answer([1.0], after=[0.1, 6.0], found=None)]
    right = [answer([1.0], after=[1.9, 4.9]), answer([40.0], after=[40.0, 90.0], passes=False, found=[40.0, 90.0])]
    assert [false(each) for each in wrong + right] == [True, True, False, False]
    row = cells(metric_table(wrong + right), "all")
    assert row[-3:] == ["2", "3", "1"]


def test_times_leave_a_maps_first_query_out():
    slow = answer([1.0], first=True, ms=dict.fromkeys(STEPS, 1000.0))
    text = times_table([slow, answer([1.0]), answer([1.0])])
    assert "1000" not in text
    assert text.count(" 10 |") == len(STEPS)
    assert cells(text, "learned, from")[1] == "30"
    assert " 1000 |" in times_table([slow])


def test_places_are_ten_metres_apart_and_best_first():
    xy = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 11.0], [50.0, 0.0], [80.0, 0.0]])
    score = np.array([1.0, 0.9, 0.5, 0.8, -np.inf])
    np.testing.assert_array_equal(distinct(xy, score), [[0.0, 0.0], [50.0, 0.0], [0.0, 11.0]])
    np.testing.assert_array_equal(distinct(xy, score, count=1), [[0.0, 0.0]])
    assert distinct(xy[:0], score[:0]).shape == (0, 2)


def test_errors_are_those_of_the_robot_not_of_the_odometrys_origin():
    told = np.array([pose_from(rot_z(0.2), [100.0, 0.0, 0.0])])
    drive = Drive("os64", 0.0, told, (np.zeros((1, 3), np.float32),), pose_from(rot_z(1.0), [5.0, 6.0, 7.0]))
    at, truth = in_odometry(drive)
    query = query_of(drive, LocalizerConfig(reloc="learned"))[0]
    np.testing.assert_allclose(at[-1, :3, 3], 0.0)
    np.testing.assert_allclose(truth @ at[-1], drive.truth)
    assert errors(truth, truth, query) == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=1e-5)
    off = pose_from(np.eye(3), [3.0, 4.0, 12.0]) @ truth
    assert errors(off, truth, query) == pytest.approx((5.0, 0.0, 13.0, 0.0), abs=1e-5)
    turned = truth @ pose_from(rot_z(np.radians(90.0)), np.zeros(3))
    assert errors(turned, truth, query) == pytest.approx((0.0, 90.0, 0.0, 90.0), abs=1e-5)


def test_a_run_is_scored_by_two_metres_and_outside_every_pose_is_false():
    truth = np.array([pose_from(np.eye(3), [10.0 * k, 0, 0]) for k in range(5)])
    poses = truth.copy()
    poses[:, 0, 3] += [0.0, 0.3, 0.0, 2.5, 0.4]
    said = told(["SEARCHING", "TRACKING", "SEARCHING", "TRACKING", "TRACKING"], poses)
    row = runs.scored(said, truth, outside=False)
    assert (row["driven_m"], row["first_fix_m"]) == (40.0, 10.0)
    assert (row["posed"], row["posed_after"], row["false"]) == (0.6, 0.75, 1)
    assert row["rmse_m"] == pytest.approx(np.sqrt((0.09 + 0.16) / 2))
    assert runs.scored(said, truth, outside=True)["false"] == 3
    silent = runs.scored(told(["SEARCHING"] * 5), truth, outside=True)
    assert (silent["false"], silent["first_fix_m"], silent["rmse_m"]) == (0, None, None)
