from argparse import ArgumentParser
from dataclasses import asdict

import pytest

from bench.integrity import integrity, work
from bench.integrity.plan import plan
from bench.integrity.store import append
from bench.integrity.work import Task
from coview_stream.errors import CoViewError, InputError


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
            result |= {"state": "SEARCHING", "reason": "said", "cost_s": 1.0, "site_s": 2.0}
            append(task.results, result)
            yield result

    monkeypatch.setattr(integrity, "everywhere", everywhere)
    return keys


def test_what_is_there_is_not_run_again_but_what_failed_is(asked, made):
    rows = list(integrity.rows(asked()))
    assert len(made) == len(set(made)) == 60
    failed = [key for key in made if key.endswith("-old")]
    assert [row.holds for row in rows if row.name.endswith("runs that failed")] == [False]
    made.clear()
    again = list(integrity.rows(asked()))
    assert made == failed
    assert (
        again[0].said
        == rows[0].said
        == f"0 of {60 - len(failed)}: below {100 * (1 - 0.05 ** (1 / (60 - len(failed)))):.2f} %"
    )


def test_other_code_runs_again_unless_any_is_good_enough(asked, made, monkeypatch):
    list(integrity.rows(asked()))
    monkeypatch.setattr(integrity, "code_of_runs", lambda: "other")
    made.clear()
    with pytest.raises(InputError, match="no result of this code"):
        list(integrity.rows(asked("--only-read")))
    list(integrity.rows(asked("--only-read", "--fingerprint", "any")))
    assert not made
    list(integrity.rows(asked()))
    assert len(made) == 60


def test_shards_make_every_run_once_and_know_each_others(asked, made):
    for share in ("1/3", "2/3", "3/3"):
        rows = list(integrity.rows(asked("--shard", share, "--families", "outside,boxes")))
    assert len(made) == len(set(made)) == 20
    assert rows[-1].details["results"][0]["family"] in ("outside, same kind", "outside, other kind", "boxes")
    assert len(rows[-1].details["results"]) == 20


@pytest.mark.parametrize("text", ["0/3", "4/3", "three", "1/0"])
def test_shares_that_are_none_are_refused(asked, text, capsys):
    with pytest.raises(SystemExit):
        asked("--shard", text)
    assert text in capsys.readouterr().err


def test_runs_with_another_risk_have_results_of_their_own(asked, made):
    list(integrity.rows(asked()))
    list(integrity.rows(asked("--risk", "0.1")))
    assert len(set(made)) == 120
    (last,) = [row for row in integrity.rows(asked()) if row.details]
    assert len(last.details["results"]) == 60


def test_a_page_has_places_for_what_is_reported_and_others_for_what_was_fitted_on(asked, made):
    for group, places in (("reported", {"", "families", "reliability"}), ("calibration", {"calibration"})):
        options = asked("--group", group)
        assert places <= set(integrity.tables(list(integrity.rows(options)), options))


def test_runs_on_a_site_that_cannot_be_mapped_fail_and_say_why(tmp_path, monkeypatch):
    def broken(run, kept):
        raise CoViewError("no ground")

    monkeypatch.setattr(work, "map_of", broken)
    site = plan("reported", 2)[0]
    results = work.on_site(site, Task(tmp_path / "r.jsonl", "code"))
    assert [(each["outcome"], each["reason"]) for each in results] == 2 * [("failed", "CoViewError: no ground")]
    assert len((tmp_path / "r.jsonl").read_text().splitlines()) == 2
