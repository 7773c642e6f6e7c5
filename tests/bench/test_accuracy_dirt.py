"""The table of dirt: every kind once, runs that differ in the dirt alone, totals that hide no failure."""

from __future__ import annotations

import math
from argparse import ArgumentParser
from dataclasses import replace

import pytest

from bench.accuracy import accuracy, dirt
from bench.accuracy.world_runs import measure
from bench.harness.worlds import TUNED_SEEDS, prepare, prepared_run, world_name
from coview_stream.sim import Dirt
from coview_stream.sim.dirt import KINDS_OF_DIRT

TINY = replace(dirt.WORLDS[0], size=120.0)


def run(**changes):
    errors = {"mean": 0.02, "rmse": 0.03, "median": 0.02, "max": 0.05}
    row = {"success": True, "false_frames": 0, "frames": 10, "posed": 9, "first_fix_m": 4.0, "reason": "verified"}
    return row | {"translation": errors, "rotation": errors} | changes


def test_kinds_are_clean_each_alone_and_all_at_once():
    worlds = [dirt.dirty(TINY, kind) for kind in dirt.KINDS]
    assert worlds[0].dirt == Dirt()
    assert [world.dirt.kinds for world in worlds[1:-1]] == [(kind,) for kind in KINDS_OF_DIRT]
    assert worlds[-1].dirt.kinds == KINDS_OF_DIRT
    assert {replace(world, dirt=Dirt()) for world in worlds} == {TINY}
    assert len({world_name(world) for world in worlds}) == len(worlds)
    assert world_name(worlds[0]) == "campus-os64-2401"
    assert world_name(worlds[-1]) == "campus-os64-2401-real"


def test_seeds_are_those_of_no_other_table():
    seeds = {world.seed for world in dirt.WORLDS}
    assert len(seeds) == 4
    assert not seeds & (TUNED_SEEDS | {world.seed for world in accuracy.held_out_worlds()})


@pytest.mark.parametrize(("kind", "own_map"), [("none", False), ("rain", False), ("years", True), ("real", True)])
def test_a_map_is_made_anew_only_where_the_dirt_concerns_it(kind, own_map, tmp_path):
    made = []

    def call(work, *args):
        made.append((work, *args))
        return run()

    dirt.run_one(tmp_path, TINY, kind, call)
    config = dirt.dirty(TINY, kind)
    assert (prepare, tmp_path, config if own_map else TINY) in made
    assert ((prepared_run, tmp_path, config) in made) is not own_map
    folder = tmp_path / world_name(config if own_map else TINY)
    assert made[-1] == (measure, tmp_path / world_name(config), folder / "site.coview", True)
    assert dirt.run_one(tmp_path, TINY, kind, call)["posed"] == 9
    assert len(made) == 2 + (not own_map)  # the second time it is known


def test_totals_count_what_was_not_found_as_endless_and_without_poses():
    lost = run(success=False, posed=0, first_fix_m=None, translation=None, rotation=None, reason="ground is off")
    row = dirt.total("snow", [run(), lost, lost])
    assert row.ours == 30.0
    assert row.details["found"] == 1
    assert math.isinf(row.details["first_fix_m"])
    assert row.details["rmse_t"] == 0.03
    assert dirt.cells(row.details) == ["snow", "1 of 3", "0", "30.0", "-", "0.030", "0.030", "ground is off"]
    assert len(dirt.cells(row.details)) == len(dirt.HEAD)


def test_a_crash_costs_one_run_and_says_why(tmp_path):
    def crash(*_):
        raise MemoryError("too large")

    row = dirt.total("rain", [dirt.run_one(tmp_path, TINY, "rain", crash)])
    assert dirt.cells(row.details)[-1] == "MemoryError: too large"


def test_false_frames_of_any_kind_miss_the_target(monkeypatch):
    for false in (0, 3):
        monkeypatch.setattr(dirt, "run_one", lambda _, __, kind, n=false: run(false_frames=n * (kind == "glass")))
        found = list(dirt.rows(1, ["none", "glass"]))
        assert len(found) == 3
        assert found[-1].holds is (false == 0)


def test_either_part_has_its_own_table(monkeypatch):
    parser = ArgumentParser()
    accuracy.options(parser)
    parser.add_argument("--quick", action="store_true")
    monkeypatch.setattr(dirt, "run_one", lambda *_: run())
    asked = parser.parse_args(["--only", "dirt", "--kinds", "rain", "snow"])
    rows = list(accuracy.rows(asked))
    tables = accuracy.tables(rows, asked)
    assert set(tables) == {"dirt"}
    assert tables["dirt"].count("4 of 4") == 2
