"""The forest benchmark's figures follow from planted results, and its command writes them into a page."""

from pathlib import Path

import numpy as np
import pytest
from bench.forest.chains import distinct

from bench.forest import forest
from bench.forest import tables as forest_tables
from bench.forest.methods import BASELINES, METHODS
from bench.forest.tables import (
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
from bench.harness.suite import OWN

ROOT = Path(__file__).parents[2]


def answer(off, kind="forest rows dense steep leaf-off column", sensor="vlp16", **more):
    """One planted answer: all methods named places so far off."""
    return {
        "world": "w",
        "kind": kind,
        "sensor": sensor,
        "travelled": 10.0,
        "chance": 0.01,
        "off": dict.fromkeys(METHODS, off),
        "dense": [1.0, 3.0],
        "moved": True,
        "chains": dict.fromkeys(BASELINES, chain([6.0, 2.0], [4.0, 3.0])),
        "before": [0.5, 1.0],
        "after": [0.1, 0.2],
        "passes": True,
        "accepted": True,
        "ms": dict.fromkeys(forest_tables.STEPS, 10.0),
        "first": False,
        **more,
    }


def chain(before, after, believed=True):
    """What one method's places were registered to."""
    return {
        "before": before,
        "after": after,
        "score": 0.5,
        "passes": believed,
        "accepted": believed,
        "ms": 80.0,
    }


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
        answer([1.0], after=None, passes=False, accepted=False, moved=False),
    ]
    assert success(answers, "after", 0.3, 1.0) == 0.25
    assert success(answers, "after", 2.0, 5.0) == 0.75
    row = cells(metric_table(answers), "all")
    assert row[1:] == [
        "4", "1.00", "3.0", "75", "0.50", "1.0", "100", "0.300", "1.00", "25", "75", "0", "3", "0",
    ]  # fmt: skip


def test_every_methods_places_are_registered_and_judged_alike():
    poor = {name: chain([9.0, 20.0], None, believed=False) for name in BASELINES}
    poor["both"] = chain([1.0, 2.0], [0.2, 0.9])
    answers = [answer([1.0]), answer([1.0], chains=poor), answer([1.0], kind="town", chains=poor)]
    lines = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in compared_table(answers).splitlines()[2:]
    ]
    assert [line[:3] for line in lines[:5]] == [["all", "3", name] for name in (*BASELINES, "learned")]
    assert {line[0] for line in lines} == {"all", "forest", "built"}
    assert len(compared_table(answers[:2]).splitlines()) == 2 + 5  # all are forests: once is enough
    of = {line[2]: line[3:] for line in lines[:5]}
    # one pose only, believed and 4 m off; two queries without any
    assert of["canopy"] == ["9.00", "20.0", "0", "4.000", "3.00", "0", "0", "1", "1", "1", "80"]
    assert of["both"] == ["1.00", "2.0", "67", "0.200", "0.90", "67", "67", "1", "3", "1", "80"]
    assert of["learned"] == ["0.50", "1.0", "100", "0.100", "0.20", "100", "100", "0", "3", "0", "10"]


def test_worlds_on_disk_alone_have_tables_of_their_own():
    planted = answer([3.0], kind="on disk")
    assert set(tables([planted])) == {f"forest disk {name}" for name in ("recall", "metric", "compared")}
    assert set(tables([planted, answer([3.0])])) == {
        "forest recall", "forest metric", "forest compared", "forest times",
    }  # fmt: skip


def test_what_is_believed_and_wrong_is_false():
    wrong = [answer([40.0], after=[40.0, 0.1]), answer([1.0], after=[0.1, 6.0], accepted=False)]
    right = [
        answer([1.0], after=[1.9, 4.9]),
        answer([40.0], after=[40.0, 90.0], passes=False, accepted=False),
    ]
    assert [false(each, "passes") for each in wrong + right] == [True, True, False, False]
    assert [false(each, "accepted") for each in wrong + right] == [True, False, False, False]
    row = cells(metric_table(wrong + right), "all")
    assert row[-3:] == ["2", "2", "1"]


def test_times_leave_a_maps_first_query_out():
    slow = answer([1.0], first=True, ms=dict.fromkeys(forest_tables.STEPS, 1000.0))
    text = times_table([slow, answer([1.0]), answer([1.0])])
    assert "1000" not in text
    assert text.count(" 10 |") == len(forest_tables.STEPS)
    assert cells(text, "learned, from")[1] == "40"
    assert " 1000 |" in times_table([slow])


def test_places_are_ten_metres_apart_and_best_first():
    xy = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 11.0], [50.0, 0.0], [80.0, 0.0]])
    score = np.array([1.0, 0.9, 0.5, 0.8, -np.inf])
    np.testing.assert_array_equal(distinct(xy, score), [[0.0, 0.0], [50.0, 0.0], [0.0, 11.0]])
    np.testing.assert_array_equal(distinct(xy, score, count=1), [[0.0, 0.0]])
    assert distinct(xy[:0], score[:0]).shape == (0, 2)


@pytest.fixture
def planted(monkeypatch):
    asked = []

    def answers(folder, options):
        asked.append((folder, options))
        return [answer([3.0])], ["drawn-1: gone"] if options.seeds == 1 else []

    monkeypatch.setattr(forest, "all_answers", answers)
    return asked


def test_the_command_puts_its_tables_between_the_markers(tmp_path, capsys, planted):
    page = tmp_path / "page.md"
    places = "".join(
        f"<!-- table: forest {n} -->\nold\n<!-- end -->\n" for n in ("recall", "metric", "compared", "times")
    )
    page.write_text(f"before\n{places}<!-- table: forest runs -->\nkept\n<!-- end -->\nafter\n")
    assert forest.main(["--work", str(tmp_path), "--write", str(page), "--quick"]) == 0
    text = page.read_text()
    assert text.startswith("before\n<!-- table: forest recall -->\n| AR@1 / AR@5, %")
    assert text.endswith("<!-- table: forest runs -->\nkept\n<!-- end -->\nafter\n")
    assert "old" not in text
    assert text.count("`python -m bench.forest --seeds 20000 --worlds 4 --queries 4`. Weights ") == 4
    assert "100 / 100" in capsys.readouterr().out


def test_a_world_that_failed_is_named_and_the_others_are_shown(tmp_path, capsys, planted):
    assert forest.main(["--seeds", "1", "--work", str(tmp_path)]) == 1
    out, err = capsys.readouterr()
    assert "100 / 100" in out
    assert "drawn-1: gone" in err


def test_a_missing_page_is_refused_before_anything_is_measured(tmp_path, capsys, planted):
    assert forest.main(["--write", str(tmp_path / "none.md"), "--work", str(tmp_path)]) == 2
    assert "there is no such page" in capsys.readouterr().err
    assert not planted


def test_answers_are_kept_per_world_until_weights_or_code_change(tmp_path, monkeypatch):
    opened = []

    def place():
        opened.append(1)
        raise RuntimeError("asked anew")

    kept = tmp_path / "answers" / "w.json"
    kept.parent.mkdir()
    monkeypatch.setattr(forest, "weights", lambda: "a")
    monkeypatch.setattr(forest, "code", lambda: "b")
    kept.write_text(
        '{"spec": {"name": "w", "weights": "a", "code": "b", "radius": 30.0, "files": "x"},'
        ' "result": {"answers": [1], "seconds": 2}}'
    )
    assert forest.asked(tmp_path, "w", place, {"files": "x"}) == [1]
    assert not opened
    with pytest.raises(RuntimeError, match="asked anew"):
        forest.asked(tmp_path, "w", place, {"files": "y"})
    monkeypatch.setattr(forest, "weights", lambda: "c")
    with pytest.raises(RuntimeError, match="asked anew"):
        forest.asked(tmp_path, "w", place, {"files": "x"})


def test_scans_that_are_not_there_are_named_in_one_line(tmp_path, capsys):
    assert forest.main(["--plot", str(tmp_path), "--work", str(tmp_path)]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("bench.forest: ")
    assert "ALS_Clip.laz" in error


def test_the_page_has_a_place_for_every_table_and_the_suite_knows_the_command():
    from bench.harness.publish import filled

    page = (ROOT / forest.PAGE).read_text()
    names = (
        "recall", "metric", "compared", "times", "scale", "runs", "plot", "disk recall", "disk metric",
        "disk compared",
    )  # fmt: skip
    assert filled(page, {f"forest {name}": "" for name in names}) != page
    assert "forest" in OWN
