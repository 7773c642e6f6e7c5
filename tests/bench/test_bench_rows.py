"""Rows judge what they compare; the command prints and writes them; the results page keeps tables that were not run."""

import json
import math
import re
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from sockets import until

import coview_stream
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
    every = fingerprint(), fingerprint(without=results.UNMEASURED), fingerprint(without=("no such file",))
    assert every[0] == every[2] != every[1]
    package = Path(coview_stream.__file__).parent
    assert all((package / name).exists() for name in results.UNMEASURED)
    files = [path for path in package.rglob("*.py") if "coview_stream.doctor" in path.read_text(encoding="utf-8")]
    assert all(str(path.relative_to(package)).startswith(results.UNMEASURED) for path in files)


def test_prose_does_not_change_the_hash_of_code():
    source = (
        b'"""One."""\nA = 1\n"""Units of A."""\ndef f(a):\n    """Two."""\n    try:\n'
        b'        return a in {"b", "c"}  # why\n    except OSError:\n        pass\n'
    )
    prose = source.replace(b'    """Two."""\n', b"").replace(b"  # why", b"").replace(b"One", b"Three\n\n")
    prose = prose.replace(b'"""Units of A."""\n', b"")
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
    texts = (("a", "old"), ("b", "kept"), ("a", "new"), ("c", "more"))
    old, other, new, third = (results.block(name, name, text, "2026-01-01", "abc1234") for name, text in texts)
    page = results.HEAD + old + other
    assert results.replaced(page, "a", new) == results.HEAD + new + other
    assert results.replaced(page, "c", third) == f"{page.rstrip()}\n{third}"
    with pytest.raises(InputError, match="no table"):
        results.chosen(["nothing"])


@pytest.fixture
def two_tables(monkeypatch, tmp_path):
    """A release of two tables, whose code and measured texts the test sets."""
    if shutil.which("git") is None:
        pytest.skip("no git, which names the commit of a table")
    said = SimpleNamespace(
        code="1", bench={"a": "3", "b": "4"}, ran=[], texts={"a": "of a", "b": "of b"}, page=tmp_path / "page.md"
    )

    def measured(command, threads, children):
        said.ran.append((command, threads))
        return said.texts[command]() if callable(said.texts[command]) else said.texts[command]

    monkeypatch.setattr(
        results, "TABLES", {"a": results.Table("a", 60, thinned="half"), "b, c": results.Table("b", 6, True)}
    )
    for name, module in {"a": "speed.search", "b": "speed.start"}.items():
        monkeypatch.setitem(results.BENCHMARKS, name, Benchmark(module, ""))

    def fingerprint(*parts, without=()):
        if not parts:
            assert without == results.UNMEASURED
            return said.code
        return said.bench["a" if "bench/speed/search.py" in parts else "b"]

    monkeypatch.setattr(results, "fingerprint", fingerprint)
    monkeypatch.setattr(results, "measured", measured)
    said.release = lambda work="one", *more: results.main(
        ["--work", str(tmp_path / work), "--page", str(said.page), "--jobs", "1", *more], release=True
    )
    return said


def test_a_release_goes_on_from_its_page_in_any_folder_and_removes_older_tables_at_its_end(two_tables, capsys):
    old = {"a": "a", "a, quick": "a", "older name": "a --fast", "by hand": "more"}
    parts = [results.block(name, by, f"kept of {name}", "2026-01-01", "abc1234") for name, by in old.items()]
    two_tables.page.write_text("# Mine\n" + "".join(parts))
    two_tables.texts["a"] = ""
    assert two_tables.release() == 1
    out, err = capsys.readouterr()
    assert "code 1: 1 of 2 tables; missing: a (of other code)" in out
    assert "code 1: 2 of 2 tables to make, about 1.1 h" in err
    page = two_tables.page.read_text()
    assert page.startswith("# Mine\n\n1 of 2 tables are of code 1.\n\n<!-- results: a -->")
    assert page.count("kept of") == 4
    two_tables.texts["a"] = "of a"
    assert two_tables.release("another") == 0
    assert two_tables.ran == [("a", None), ("b", 1), ("a", None)]
    assert "1 of 2 tables to make, about 1.0 h" in capsys.readouterr().err
    page = two_tables.page.read_text()
    assert page.startswith("# Mine\n\n2 of 2 tables are of code 1.\n\n<!-- results: a -->")
    assert page.endswith(parts[-1])
    assert page.count("kept of") == 1
    assert ", code 1, bench 3, 0.0 min; thinned: half\n\nof a\n" in page
    assert two_tables.release("third") == 0
    assert two_tables.page.read_text() == page
    two_tables.code = "2"
    assert two_tables.release() == 0
    assert two_tables.ran[3:] == [("a", None), ("b", 1)]
    assert "2 of 2 tables are of code 2.\n" in two_tables.page.read_text()
    results.TABLES["b, c"] = results.Table("a", 6)  # another command: the table on the page is not it
    assert two_tables.release() == 0
    assert two_tables.ran[5:] == [("a", None)]
    two_tables.bench["b"] = "5"  # of neither
    assert two_tables.release() == 0
    two_tables.bench["a"] = "6"  # of both
    assert two_tables.release() == 0
    assert two_tables.ran[6:] == [("a", None), ("a", None)]


def test_a_benchmark_of_which_a_part_failed_makes_no_table(capsys):
    class Broken:
        """A child process that writes a figure, and a row of a world that ended in an exception."""

        def run(self, line, threads):
            rows = [informs("search/town", 3, "ms"), failed("search/campus", "TypeError: no argument")]
            Path(line[-1]).write_text(json.dumps([row.to_dict() for row in rows]))
            return 1

    assert results.measured("search", 1, Broken()) == ""
    assert "search/campus: TypeError: no argument" in capsys.readouterr().err


def test_a_release_refuses_two_codes_and_goes_on_after_a_table_that_fails(two_tables, capsys):
    two_tables.texts["a"] = lambda: 1 / 0
    assert two_tables.release() == 1
    assert "1 of 2 tables; missing: a" in capsys.readouterr().out
    two_tables.texts["a"] = lambda: setattr(two_tables, "code", "3") or "other"
    assert two_tables.release() == 2
    assert "the code changed meanwhile" in capsys.readouterr().err
    assert "other" not in two_tables.page.read_text()


def test_processes_end_with_an_interrupted_release_and_none_begins_after_it(tmp_path):
    children, begun = results.Children(), tmp_path / "begun"
    deaf = f"import signal, time; signal.signal(15, signal.SIG_IGN); open({str(begun)!r}, 'w'); time.sleep(60)"
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(children.run, [sys.executable, "-c", deaf], None)
        until(begun.exists)
        children.end(0.1)
        assert running.result(timeout=30) is None
    assert children.run([sys.executable, "-c", "pass"], None) is None
    assert results.Children().run([sys.executable, "-c", "raise SystemExit(3)"], 1) == 3


def test_an_interrupted_release_keeps_no_table_that_was_cut_short(two_tables):
    def cut():
        raise KeyboardInterrupt

    two_tables.texts["a"] = cut
    with pytest.raises(KeyboardInterrupt):
        two_tables.release()
    assert not two_tables.page.exists()
    assert two_tables.ran == [("a", None)]


def test_every_benchmark_has_a_table_and_understands_its_commands():
    commands = [line.split() for entry in results.TABLES.values() for line in (entry.command, entry.quick) if line]
    assert {name for name, *_ in commands} == set(BENCHMARKS)
    for name, *words in commands:
        if not BENCHMARKS[name].module.startswith(("stream", "soak")):  # psutil: extra bench
            bench.parser_of(name).parse_args(words)
            assert callable(BENCHMARKS[name].load().rows)


def test_pages_take_figures_from_tables_that_a_release_makes():
    text = results.PAGE.with_name("limits.md").read_text(encoding="utf-8")
    assert set(re.findall(r"<!-- ([\w ]+), ", text)) <= set(results.TABLES)


def test_all_tables_end_in_twelve_hours_on_two_cores():
    assert sum(entry.minutes / (2 if entry.beside else 1) for entry in results.TABLES.values()) < 12 * 60


@pytest.mark.slow
def test_a_benchmark_that_fails_is_a_row(capfd):
    (row,) = run("peers", ["--trial", "nobody", "map", "places"], None)
    assert (row.name, row.holds) == ("peers: ended with exit code 1", False)
