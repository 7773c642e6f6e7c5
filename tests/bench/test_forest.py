"""Scores of the forest benchmarks follow from planted answers."""

import numpy as np

from bench.forest.forest import METHODS, distinct, false, recall, success


def answer(off, **more):
    """One planted answer: all methods named places so far off."""
    planted = {
        "kind": "forest rows dense steep leaf-off column", "off": dict.fromkeys(METHODS, off), "after": [0.1, 0.2],
        "passes": True, "found": [0.1, 0.2],
    }  # fmt: skip
    return planted | more


def test_recall_counts_the_best_and_the_best_five():
    answers = [answer([3.0, 50.0]), answer([50.0, 9.9]), answer([10.0, 10.1, 80.0]), answer([])]
    assert (recall(answers, "search", 1), recall(answers, "search", 5)) == (0.25, 0.5)


def test_metric_success_needs_both_metres_and_degrees_and_a_wrong_pose_that_passes_is_false():
    answers = [
        answer([1.0], after=[0.3, 1.0]),
        answer([1.0], after=[0.31, 0.1]),
        answer([1.0], after=[0.1, 1.1]),
        answer([1.0], after=None, passes=False, found=None),
    ]
    assert (success(answers, 0.3, 1.0), success(answers, 2.0, 5.0)) == (0.25, 0.75)
    wrong = [answer([40.0], after=[40.0, 0.1]), answer([1.0], after=[0.1, 6.0])]
    right = [answer([1.0], after=[1.9, 4.9]), answer([40.0], after=[40.0, 90.0], passes=False)]
    assert [false(each) for each in wrong + right] == [True, True, False, False]


def test_places_are_ten_metres_apart_and_best_first():
    xy = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 11.0], [50.0, 0.0], [80.0, 0.0]])
    score = np.array([1.0, 0.9, 0.5, 0.8, -np.inf])
    np.testing.assert_array_equal(distinct(xy, score), [[0.0, 0.0], [50.0, 0.0], [0.0, 11.0]])
