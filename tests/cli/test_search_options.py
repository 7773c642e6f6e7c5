"""``--risk`` and ``--reloc`` of ``locate`` and ``serve``, and ``build --learned``."""

import json
from dataclasses import replace

import pytest
from any_risk import NEVER

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.file_format import load, save
from coview_stream.cli import main
from coview_stream.cli.options import acceptance_config
from coview_stream.config import LocalizerConfig
from coview_stream.config.localizer import LEAST_RISK
from coview_stream.descriptors.network import network
from coview_stream.geometry.protection import LEAST
from coview_stream.localization import offline
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.search.acceptance import BY_FEATURES
from coview_stream.stream.node.engine_process import EngineProcess
from coview_stream.stream.node.engine_queue import SearchJob


@pytest.mark.parametrize("given", ["0", "0.5", "-1e-4", "1", "nan", "inf", "1e-400", "0.99e-6", "small", ""])
def test_risk_that_is_no_small_probability_is_refused_before_anything_is_read(tmp_path, refused, given):
    none = str(tmp_path / "not-even-looked-for.coview")
    locate = ["locate", none, "run", "-o", str(tmp_path / "o")]
    for command in (["serve", none, "--robot", "r1", "--no-state"], locate, ["info", none, "--ambiguity"]):
        said = refused(*command, f"--risk={given}")
        assert f"--risk {given}: give the probability" in said
        assert "[1e-6, 0.5), such as 1e-4" in said


def test_smallest_risk_is_what_is_told_apart_in_words():
    assert LEAST_RISK == acceptance_config("1e-6").risk > LEAST


def test_locate_passes_risk_option_to_the_search(world_file, world_run, tmp_path, monkeypatch):
    """Whose result is none where nothing is that certain."""
    usual, asked = offline.locate, []

    def never_sure(base_map, run, config, *rest):
        asked.append(config.acceptance.risk)
        return usual(base_map, run, replace(config, acceptance=NEVER), *rest)

    monkeypatch.setattr(offline, "locate", never_sure)
    out = tmp_path / "out"
    command = ["locate", str(world_file), str(world_run), "-o", str(out), "--no-pictures"]
    assert main([*command, "--risk", "1e-6"]) == 1
    assert asked == [1e-6]
    result = json.loads((out / "result.json").read_text())
    assert {each["state"] for each in result["keyframes"]} == {"AMBIGUOUS"}


def test_reloc_learned_on_map_without_features_names_remedy(world_file, tmp_path, refused):
    run, out = tmp_path / "not-even-looked-for", tmp_path / "out"
    for command in (["locate", world_file, run, "-o", out], ["serve", world_file, "--robot", "r1", "--no-state"]):
        said = refused(*command, "--reloc", "learned")
        assert "build it again" in said
        assert "--reloc coview" in said


@pytest.mark.slow
def test_search_engine_process_uses_learned_features(learned_file, world_drive):
    base_map = BaseMap.load(learned_file)
    localizer = Localizer(base_map, LocalizerConfig(reloc="learned"))
    query = localizer.add_frame(world_drive.clouds[0], world_drive.T_odom_body[0], 0.0)
    process = EngineProcess("search", str(learned_file), base_map.sha256, LocalizerConfig(reloc="learned"))
    try:
        process.start()
        process.wait_ready()
        assert process.run(SearchJob("r1", query)).evidence.reason.endswith(BY_FEATURES)
    finally:
        process.close()


def test_build_names_missing_weights(tmp_path, monkeypatch, refused):
    monkeypatch.setenv("COVIEW_WEIGHTS", str(tmp_path))
    network.cache_clear()
    scan = tmp_path / "not-even-looked-for.ply"
    assert "no weights of the aerial network" in refused("build", scan, "-o", tmp_path / "site.coview")


@pytest.fixture(scope="module")
def learned_file(map_cloud_file, tmp_path_factory):
    path = tmp_path_factory.mktemp("learned") / "site.coview"
    given = ["build", str(map_cloud_file), "-o", str(path), "--radius", "20", "--block-size", "4"]
    assert main([*given, "--learned"]) == 0
    return path


@pytest.mark.slow
def test_build_learned_stores_features_and_info_shows_them(learned_file, capsys):
    assert BaseMap.load(learned_file).learned is not None
    assert main(["info", str(learned_file)]) == 0
    assert "features of" in capsys.readouterr().out


def test_features_of_other_weights_are_refused_or_skipped(learned_file, tmp_path, capsys):
    arrays, parameters, _ = load(learned_file)
    parameters["learned"]["weights"] = "0" * 64
    save(tmp_path / "old.coview", arrays, parameters)
    given = ["locate", str(tmp_path / "old.coview"), "run", "-o", str(tmp_path / "out"), "--reloc"]
    for reloc, messages in (
        ("learned", [["build it again"]]),
        ("auto", [["going without learned features", "build it again"], ["error: run"]]),
        ("coview", [["error: run"]]),
    ):
        assert main([*given, reloc]) == 2  # there is no such run
        for line, parts in zip(capsys.readouterr().err.splitlines(), messages, strict=True):
            assert all(part in line for part in parts)
