"""The suite's runner judges, survives what its benchmarks do, and writes a whole file or none."""

import json
import math

import pytest

from bench import __main__ as bench
from bench.harness import rows
from bench.harness.rows import Row, against, bounded, compared, failed, informs, medians, reached
from bench.harness.suite import OWN, SUITE, Entry, thread_settings

KEYS = ["name", "ours", "baseline", "unit", "ratio", "target", "holds"]

FAKE = """
import os, signal, sys, time
from bench.harness.rows import Row, bounded, informs

def rows(quick=False):
    kind = __name__.rsplit("_", 1)[-1]
    print("chatter of the benchmark")
    if kind == "empty":
        return
    yield Row("fake/" + kind, 1.0, 3.0, "ms", 3.0, ">= 2", True)
    yield informs("fake/threads", float(os.environ.get("COVIEW_THREADS", "0")), "threads")
    yield bounded("fake/quick", 5.0 if quick else 50.0, "s", 10.0)
    if kind == "raises":
        raise RuntimeError("no such luck")
    if kind == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "hangs":
        time.sleep(600)
"""


@pytest.fixture
def entry(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def make(kind, threads=(None,), limit_s=60.0):
        (tmp_path / f"fake_{kind}.py").write_text(FAKE)
        return Entry(kind, "made up", threads, limit_s, module=f"fake_{kind}")

    return make


def names(file):
    return [row["name"] for row in json.loads(file.read_text())]


def test_rows_judge_what_they_compare(monkeypatch):
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
    assert failed("d", "gone").holds is False
    monkeypatch.setattr(rows, "medians", lambda *sides, repeat: [2.0, 10.0])
    assert compared("e", print, print, 4.0) == Row("e", 2.0, 10.0, "ms", 5.0, ">= 4", True)


def test_medians_take_turns_and_warm_up_first(monkeypatch):
    calls, clock = [], iter(range(10_000))
    monkeypatch.setattr(rows.time, "perf_counter", lambda: float(next(clock)))
    sides = [lambda k=k: calls.append(k) for k in range(3)]
    assert medians(*sides, repeat=4) == [1e3, 1e3, 1e3]
    assert calls == [0, 1, 2, 0, 1, 2, 2, 1, 0, 0, 1, 2, 2, 1, 0]
    with pytest.raises(ValueError, match="at least one"):
        medians(*sides, repeat=0)


def test_a_row_survives_json_and_has_the_seven_keys():
    for row in (failed("x", "gone"), bounded("b", 8.0, "ms", 8.0)):
        there = json.loads(json.dumps(row.to_dict(), allow_nan=False))
        assert list(there) == KEYS
        assert repr(Row.from_dict(there)) == repr(row)
    with pytest.raises(ValueError, match="a row has name"):
        Row.from_dict({"name": "x"})


def test_every_row_is_printed_with_its_verdict_and_written(entry, tmp_path, capfd):
    file = tmp_path / "rows.json"
    assert bench.main(["--json", str(file), "--quick"], [entry("good")]) == 0
    written = json.loads(file.read_text())
    assert [list(row) for row in written] == [KEYS] * 3
    assert written[0] == {
        "name": "fake/good, quick", "ours": 1.0, "baseline": 3.0, "unit": "ms", "ratio": 3.0,
        "target": ">= 2", "holds": True,
    }  # fmt: skip
    out, err = capfd.readouterr()
    verdicts = [line.split("|")[-2].strip() for line in out.splitlines() if "fake/" in line]
    assert verdicts == ["holds", "informs", "holds"]
    assert len({len(line) for line in out.splitlines() if line.startswith("|")}) == 1
    assert "2 of 2 targets hold" in out
    assert "chatter" not in out + err
    assert [path.name for path in tmp_path.glob("*.json*")] == ["rows.json"]


def test_a_missed_target_is_the_exit_code(entry, capfd):
    assert bench.main([], [entry("good")]) == 1
    out = capfd.readouterr().out
    assert "DOES NOT HOLD" in out
    assert "1 of 2 targets hold" in out


@pytest.mark.parametrize(
    ("kind", "why", "limit_s"),
    [
        ("raises", "ended with exit code 1", 60.0),
        ("killed", "ended by signal SIGKILL", 60.0),
        ("empty", "yielded no row", 60.0),
        ("hangs", "ran past its 3 s", 3.0),
    ],
)
def test_a_benchmark_that_fails_is_a_row_and_the_next_one_runs(entry, tmp_path, capfd, kind, why, limit_s):
    file = tmp_path / "rows.json"
    suite = [entry(kind, limit_s=limit_s), entry("good")]
    assert bench.main(["--quick", "--json", str(file)], suite) == 1
    failures = [row for row in json.loads(file.read_text()) if row["holds"] is False]
    assert [row["name"] for row in failures] == [f"{kind}, quick: {why}"]
    assert failures[0]["ours"] is None
    assert names(file)[-3:] == ["fake/good, quick", "fake/threads, quick", "fake/quick, quick"]
    assert ("no such luck" in capfd.readouterr().err) == (kind == "raises")


def test_threads_reach_the_benchmark_and_its_names(entry, tmp_path, capfd, monkeypatch):
    file = tmp_path / "rows.json"
    monkeypatch.setattr(bench.os, "cpu_count", lambda: 2)
    suite = [entry("good", threads=(1, 2, 4))]
    bench.main(["--json", str(file)], suite)
    told = [(row["name"], row["ours"]) for row in json.loads(file.read_text()) if "threads" in row["unit"]]
    assert told == [("fake/threads, 1 thread", 1.0), ("fake/threads, 2 threads", 2.0)]
    bench.main(["--json", str(file), "--threads", "1"], suite)
    assert names(file) == ["fake/good, 1 thread", "fake/threads, 1 thread", "fake/quick, 1 thread"]
    assert thread_settings(None) == {}
    assert set(thread_settings(2)) == {"OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "COVIEW_THREADS"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nothing"], ["no benchmark 'nothing'", "kernels", "match", "peers"]),
        (["accuracy"], ["python -m bench.accuracy"]),
        (["--json", "no/such/place/rows.json"], ["no directory no/such/place"]),
        (["--json", "."], ["is a directory"]),
    ],
)
def test_what_cannot_be_run_is_refused_in_one_line(capfd, arguments, words):
    assert bench.main(arguments) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert all(word in err for word in words)


def test_interrupted_it_writes_nothing(entry, tmp_path, capfd, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(bench, "run", interrupted)
    assert bench.main(["--json", str(tmp_path / "rows.json")], [entry("good")]) == 130
    assert list(tmp_path.glob("rows.json*")) == []


def test_the_list_names_all(capfd):
    assert bench.main(["--list"]) == 0
    out = capfd.readouterr().out
    assert all(entry.name in out for entry in SUITE)
    assert all(f"bench.{name}" in out for name in OWN)
    assert len({entry.name for entry in SUITE}) == len(SUITE)
