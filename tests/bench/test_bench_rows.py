"""Rows judge what they compare; the command prints and writes them; the results page keeps tables that were not run."""

import json
import math
import re
from types import SimpleNamespace

import pytest

from bench import __main__ as bench
from bench import results
from bench.__main__ import BENCHMARKS, Benchmark, run
from bench.harness.files import code_of, fingerprint, remembered
from bench.harness.rows import Row, against, bounded, failed, informs, judged, reached
from coview_stream.errors import InputError


def test_rows_judge_what_they_compare():
    assert against("a", 2.0, 6.0, "ms", 3.0) == Row("a", 2.0, 6.0, "ms", 3.0, ">= 3", True)
    assert against("a", 2.0, 5.9, "ms", 3.0).holds is False
    assert against("a", 2.0, 6.0, "ms", None).holds is None
    assert bounded("b", 8.0, "ms", 8.0) == Row("b", 8.0, None, "ms", None, "<= 8 ms", True)
    assert reached("r", 95.0, "%", 95.0) == Row("r", 95.0, None, "%", None, ">= 95 %", True)
    for missed in (bounded("b", 8.1, "ms", 8.0), bounded("b", math.nan, "ms", 8.0), reached("r", 94.9, "%", 95.0)):
        assert missed.holds is False
    assert reached("r", math.nan, "%", 95.0).holds is False
    assert judged("j", "3 of 4", "all", False, 3).text == "3 of 4"
    assert (informs("c", 1.0, "MB").holds, failed("d", "gone").holds) == (None, False)


def test_a_row_survives_json():
    row = Row("fake/first", math.nan, 3.0, "ms", 3.0, ">= 2", True, details={"all": [1, math.nan]})
    there = Row.from_dict(json.loads(json.dumps(row.to_dict(), allow_nan=False)))
    assert repr(there).replace("None]", "nan]") == repr(row)
    with pytest.raises(ValueError, match="a row has name"):
        Row.from_dict({"name": "x"})


def test_a_result_is_reused_for_the_same_spec_only(tmp_path):
    file = tmp_path / "deep" / "result.json"
    assert remembered(file, {"code": "a", "size": (1, 2)}, lambda: {"value": int(not file.parent.exists())}) == {
        "value": 1
    }
    assert remembered(file, {"code": "a", "size": (1, 2)}, lambda: {"value": 2}) == {"value": 1}
    assert remembered(file, {"code": "b", "size": (1, 2)}, lambda: {"value": 3}) == {"value": 3}
    assert [path.name for path in tmp_path.rglob("*")] == ["deep", "result.json"]  # no lock is left
    parts = ("coview_stream/sim", "coview_stream/descriptors/coview.py", "coview_kernels", "")
    assert len({fingerprint(part) if part else fingerprint() for part in parts}) == len(parts)


def test_prose_does_not_change_the_hash_of_code():
    source = (
        b'"""One."""\ndef f(a):\n    """Two."""\n    try:\n'
        b'        return a in {"b", "c"}  # why\n    except OSError:\n        pass\n'
    )
    prose = source.replace(b'    """Two."""\n', b"").replace(b"  # why", b"").replace(b"One", b"Three\n\n")
    assert code_of(source) == code_of(prose)
    for old, new in ((b'"c"', b'"d"'), (b"return a", b"return not a"), (b"OSError", b"KeyError"), (b"(a)", b"(a, b)")):
        assert code_of(source) != code_of(source.replace(old, new))
    assert code_of(source, ".npz") == source


@pytest.fixture
def planted(monkeypatch):
    def fake(asked):
        yield Row("fake/first", 1.0, 3.0, "ms", 3.0, ">= 2", True)
        yield bounded("fake/quick", 5.0 if asked.quick else 50.0, "s", 10.0)

    module = SimpleNamespace(rows=fake, tables=lambda rows, asked: {"wide": f"{len(rows)} rows"}, __doc__="Made up.")
    monkeypatch.setattr(Benchmark, "load", lambda self: module)
    monkeypatch.setitem(BENCHMARKS, "fake", Benchmark("fake", "made up"))


def test_rows_are_printed_and_written_and_a_missed_target_is_the_exit_code(planted, tmp_path, capsys):
    file = tmp_path / "rows.json"
    assert bench.main(["fake", "--json", str(file), "--quick"]) == 0
    out = capsys.readouterr().out
    assert "fake wide\n\n2 rows\n" in out
    assert "2 of 2 targets hold" in out
    assert [row["name"] for row in json.loads(file.read_text())] == ["fake/first", "fake/quick"]
    assert bench.main(["fake"]) == 1
    assert "DOES NOT HOLD" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["nothing"], "no benchmark 'nothing'"), (["fake", "--json", "no/such/rows.json"], "--json no/such/rows.json")],
)
def test_a_wrong_command_is_refused_in_one_line(planted, capsys, arguments, words):
    assert bench.main(arguments) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert words in err


def test_only_tables_that_were_run_change_the_page():
    page = results.HEAD + results.block("fake", "fake --quick", "old", "2026-01-01", "abc1234")
    other = results.block("other", "other", "kept", "2026-01-02", "abc1234")
    again = results.replaced(
        page + other, "fake", results.block("fake", "fake --quick", "new", "2026-02-01", "def5678")
    )
    assert "old" not in again
    assert "new" in again
    assert other in again
    added = results.replaced(again, "third", results.block("third", "third", "more", "2026-02-01", "def5678"))
    assert added.startswith(again.rstrip())
    with pytest.raises(InputError, match="no table"):
        results.chosen(["nothing"])


@pytest.fixture
def two_tables(monkeypatch, tmp_path):
    """A release of two tables, whose code and measured texts the test sets."""
    said = SimpleNamespace(code="1", ran=[], texts={"a": "of a", "b": "of b"}, work=tmp_path, page=tmp_path / "page.md")

    def measured(command, threads):
        said.ran.append((command, threads))
        return said.texts[command]() if callable(said.texts[command]) else said.texts[command]

    monkeypatch.setattr(
        results, "TABLES", {"a": results.Table("a", 60, thinned="half"), "b, c": results.Table("b", 6, True)}
    )
    monkeypatch.setattr(results, "fingerprint", lambda *parts: said.code)
    monkeypatch.setattr(results, "measured", measured)
    said.release = lambda: results.main(
        ["--work", str(tmp_path), "--page", str(said.page), "--jobs", "1"], release=True
    )
    return said


def test_a_release_goes_on_with_missing_tables_and_writes_a_page_of_one_code(two_tables, capsys):
    old = {"a": "a", "a, quick": "a", "older name": "a --fast", "by hand": "more"}
    parts = [results.block(name, by, f"kept of {name}", "2026-01-01", "abc1234") for name, by in old.items()]
    two_tables.page.write_text("# Mine\n" + "".join(parts))
    two_tables.texts["b"] = ""
    assert two_tables.release() == 1
    out, err = capsys.readouterr()
    assert "code 1: 1 of 2 tables; missing: b, c" in out
    assert "code 1: 2 of 2 tables to make, about 1.1 h" in err
    assert "older name" in two_tables.page.read_text()
    two_tables.texts["b"] = "of b"
    assert two_tables.release() == 0
    assert two_tables.ran == [("a", None), ("b", 1), ("b", 1)]
    page = two_tables.page.read_text()
    assert page.startswith("# Mine\n\n<!-- results: a -->")
    assert page.endswith(parts[-1])
    assert page.count("kept of") == 1
    assert ", code 1, 0.0 min; thinned: half\n\nof a\n" in page
    assert "1 of 2 tables to make, about 0.1 h" in capsys.readouterr().err
    two_tables.code = "2"
    assert two_tables.release() == 0
    assert two_tables.ran[3:] == [("a", None), ("b", 1)]


def test_a_release_refuses_two_codes_and_goes_on_after_a_table_that_fails(two_tables, capsys):
    two_tables.texts["a"] = lambda: 1 / 0
    assert two_tables.release() == 1
    assert "1 of 2 tables; missing: a" in capsys.readouterr().out
    two_tables.texts["a"] = lambda: setattr(two_tables, "code", "3") or "other"
    assert two_tables.release() == 2
    assert "the code changed meanwhile" in capsys.readouterr().err
    assert not two_tables.page.exists()


def test_an_interrupted_release_keeps_no_table_that_was_cut_short(two_tables):
    def cut():
        raise KeyboardInterrupt

    two_tables.texts["a"] = cut
    with pytest.raises(KeyboardInterrupt):
        two_tables.release()
    assert not list(two_tables.work.glob("tables-*/*.md"))
    assert two_tables.ran == [("a", None)]


def test_every_table_has_a_command_that_its_benchmark_understands():
    for entry in results.TABLES.values():
        for command in (entry.command, entry.quick or entry.command):
            name, *words = command.split()
            if not BENCHMARKS[name].module.startswith(("stream", "soak")):  # psutil: extra bench
                bench.parser_of(name).parse_args(words)


def test_pages_take_figures_from_tables_that_a_release_makes():
    text = results.PAGE.with_name("limits.md").read_text(encoding="utf-8")
    assert set(re.findall(r"<!-- ([\w ]+), ", text)) <= set(results.TABLES)


def test_all_tables_end_in_twelve_hours_on_two_cores():
    assert sum(entry.minutes / (2 if entry.beside else 1) for entry in results.TABLES.values()) < 12 * 60


def test_every_benchmark_loads():
    for entry in BENCHMARKS.values():
        if not entry.module.startswith(("stream", "soak")):  # they watch processes with psutil: extra bench
            assert callable(entry.load().rows)


@pytest.mark.slow
def test_a_benchmark_that_fails_is_a_row(capfd):
    (row,) = run("peers", ["--trial", "nobody", "map", "places"], None)
    assert (row.name, row.holds) == ("peers: ended with exit code 1", False)
