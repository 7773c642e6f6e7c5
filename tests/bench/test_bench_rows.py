"""Rows judge what they compare; the command prints them, writes a whole file or none, and fills pages."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest

from bench import __main__ as bench
from bench.forest.worlds import ANSWERS
from bench.harness import rows
from bench.harness.files import fingerprint
from bench.harness.rows import Row, against, bounded, failed, informs, judged, medians, reached
from bench.harness.suite import BENCHMARKS, Benchmark, run, thread_settings
from bench.harness.tables import filled, missed, suite_tables
from bench.harness.worlds import MAPPER
from coview_stream.errors import InputError

DOCS = Path(__file__).parents[2] / "docs"
PLACED = "before\n<!-- table: bench match -->\nold\n<!-- end -->\nafter\n<!-- table: machine -->\nwas\n<!-- end -->\n"
ROWS = [against("match/top 10, 1 thread", 2.0, 8.0, "ms", 3), bounded("start/import", 0.1, "s", 0.25)]


def fake(asked):
    yield Row("fake/first", 1.0, 3.0, "ms", 3.0, ">= 2", True, details={"all": [1, math.nan]})
    yield informs("fake/second", 2.0, "s")
    yield bounded("fake/quick", 5.0 if asked.quick else 50.0, "s", 10.0)


@pytest.fixture
def planted(monkeypatch):
    module = SimpleNamespace(rows=fake, tables=lambda rows, asked: {"wide": f"{len(rows)} rows"}, __doc__="Made up.")
    monkeypatch.setattr(Benchmark, "load", lambda self: module)
    monkeypatch.setitem(BENCHMARKS, "fake", Benchmark("fake", "made up"))


def test_rows_judge_what_they_compare():
    assert against("a", 2.0, 6.0, "ms", 3.0) == Row("a", 2.0, 6.0, "ms", 3.0, ">= 3", True)
    assert against("a", 2.0, 5.9, "ms", 3.0).holds is False
    assert against("a", 2.0, 6.0, "ms", None).holds is None
    assert bounded("b", 8.0, "ms", 8.0) == Row("b", 8.0, None, "ms", None, "<= 8 ms", True)
    assert bounded("b", 8.1, "ms", 8.0).holds is False
    assert bounded("b", math.nan, "ms", 8.0).holds is False
    assert reached("r", 95.0, "%", 95.0) == Row("r", 95.0, None, "%", None, ">= 95 %", True)
    assert reached("r", 94.9, "%", 95.0).holds is False
    assert reached("r", math.nan, "%", 95.0).holds is False
    assert informs("c", 1.0, "MB").holds is None
    assert judged("j", "3 of 4", "all", False, 3).said == "3 of 4"
    assert failed("d", "gone").holds is False


def test_medians_take_turns_and_warm_up_first(monkeypatch):
    calls, clock = [], iter(range(10_000))
    monkeypatch.setattr(rows.time, "perf_counter", lambda: float(next(clock)))
    sides = [lambda k=k: calls.append(k) for k in range(3)]
    assert medians(*sides, repeat=4) == [1e3, 1e3, 1e3]
    assert calls == [0, 1, 2, 0, 1, 2, 2, 1, 0, 0, 1, 2, 2, 1, 0]
    with pytest.raises(ValueError, match="at least one"):
        medians(*sides, repeat=0)


def test_a_row_survives_json():
    for row in (failed("x", "gone"), bounded("b", 8.0, "ms", 8.0), next(fake(None))):
        there = Row.from_dict(json.loads(json.dumps(row.to_dict(), allow_nan=False)))
        assert repr(there).replace("None]", "nan]") == repr(row)
    with pytest.raises(ValueError, match="a row has name"):
        Row.from_dict({"name": "x"})


def test_every_row_is_printed_with_its_verdict_and_written(planted, tmp_path, capfd):
    file = tmp_path / "rows.json"
    assert bench.main(["fake", "--json", str(file), "--quick"]) == 0
    out = capfd.readouterr().out
    verdicts = [line.split("|")[-2].strip() for line in out.splitlines() if "fake/" in line]
    assert verdicts == ["holds", "informs", "holds"]
    assert "bench fake wide\n\n3 rows\n" in out
    assert "2 of 2 targets hold" in out
    assert [row["name"] for row in json.loads(file.read_text())] == ["fake/first", "fake/second", "fake/quick"]
    assert [path.name for path in tmp_path.iterdir()] == ["rows.json"]
    assert bench.main(["fake", "--read", str(file)]) == 0
    assert capfd.readouterr().out.splitlines()[:7] == out.splitlines()[:7]


def test_a_missed_target_is_the_exit_code(planted, capfd):
    assert bench.main(["fake"]) == 1
    out = capfd.readouterr().out
    assert "DOES NOT HOLD" in out
    assert "1 of 2 targets hold" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nothing"], ["no benchmark 'nothing'", "kernels", "match", "peers"]),
        (["fake", "--json", "no/such/place/rows.json"], ["--json no/such/place/rows.json"]),
        (["fake", "--json", "."], ["--json ."]),
        (["fake", "--write", "none.md"], ["none.md: there is no such file"]),
    ],
)
def test_what_cannot_be_run_is_refused_in_one_line(planted, capfd, arguments, words):
    assert bench.main(arguments) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert all(word in err for word in words)


@pytest.mark.slow
def test_a_benchmark_that_fails_is_a_row(capfd):
    (row,) = run("peers", ["--trial", "nobody", "map", "places"], None)
    assert (row.name, row.holds) == ("peers: ended with exit code 1", False)
    assert "StopIteration" in capfd.readouterr().err
    (row,) = run("kernels", ["--quick"], 1, limit_s=0.1)
    assert row.name == "kernels, 1 thread, quick: ran past its 0.1 s"
    assert thread_settings(None) == {}
    assert set(thread_settings(2)) == {"OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "COVIEW_THREADS"}


def test_every_benchmark_loads_and_every_part_of_a_fingerprint_is_there():
    for entry in BENCHMARKS.values():
        if entry.module != "stream.stream":  # watches the node with psutil: extra bench
            assert callable(entry.load().rows)
    assert len({fingerprint(), *map(fingerprint, (*ANSWERS, *MAPPER))}) > len(ANSWERS)


def test_only_tables_that_were_measured_change_a_page():
    assert filled(PLACED, {"bench match": "new"}) == PLACED.replace("old", "new")
    with pytest.raises(InputError, match="no place for bench start"):
        filled(PLACED, suite_tables(ROWS[1:]))


def test_targets_that_do_not_hold_are_listed():
    slow = bounded("start/serve", 3.0, "s", 2.0)
    assert missed(ROWS) == "2 of 2 targets hold."
    assert missed([*ROWS, slow, informs("c", 1.0, "MB")]) == "2 of 3 targets hold.\n\n* start/serve: 3 s"


def test_rows_are_shown_under_their_benchmark():
    tables = suite_tables(ROWS)
    assert list(tables) == ["bench match", "bench start"]
    row = tables["bench match"].splitlines()[2]
    assert [cell.strip() for cell in row.split("|")[1:-1]] == [
        "top 10, 1 thread", "2", "8", "ms", "4", ">= 3", "holds",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("page", "places"),
    [
        ("performance", [*(name for name, entry in BENCHMARKS.items() if entry.suite is not None and name != "frame"),
                         "intake", "describe", "peers worlds", "where"]),
        ("forest", [f"forest {part}" for part in ("recall", "metric", "compared", "times", "disk recall",
                    "disk metric", "disk compared")] + ["forest_scale", "forest_runs", "forest_plot",
                    "forest_plot walks"]),
        ("tracking", ["tracking", "tracking coverage", "tracking protection"]),
        ("integrity", ["integrity", "integrity families", "integrity reliability", "protection", "protection tails"]),
        ("accuracy", ["accuracy", "accuracy dirt", "ablation", "ground"]),
    ],
)  # fmt: skip
def test_pages_have_a_place_for_every_table(page, places):
    text = (DOCS / f"{page}.md").read_text()
    assert [place for place in places if f"<!-- table: bench {place} -->" not in text] == []
