"""``--risk`` of ``locate`` and ``serve``: it reaches those who search, in processes of their own too."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from any_risk import NEVER

from coview_stream.cli import build_parser, main
from coview_stream.cli.options import acceptance_config
from coview_stream.config import AcceptanceConfig
from coview_stream.config.localizer import LEAST_RISK
from coview_stream.geometry.protection import LEAST
from coview_stream.localization import offline

SERVE = ["serve", "site.coview", "--robot", "r1"]
LOCATE = ["locate", "site.coview", "run", "-o", "out"]


@pytest.mark.parametrize("command", [SERVE, LOCATE])
def test_default_risk_is_that_of_the_configuration(command):
    assert build_parser().parse_args(command).risk in (None, AcceptanceConfig().risk)  # None: the configuration's


@pytest.mark.parametrize("given", ["0", "0.5", "-1e-4", "1", "nan", "inf", "1e-400", "0.99e-6", "small", ""])
def test_risk_that_is_no_small_probability_is_refused_before_anything_is_read(tmp_path, capsys, given):
    none = str(tmp_path / "not-even-looked-for.coview")
    locate = ["locate", none, "run", "-o", str(tmp_path / "o")]
    for command in (["serve", none, "--robot", "r1", "--no-state"], locate, ["info", none, "--ambiguity"]):
        assert main([*command, f"--risk={given}"]) == 2
        said = capsys.readouterr().err
        assert f"--risk {given}: give the probability" in said
        assert "[1e-6, 0.5), such as 1e-4" in said
        assert said.count("\n") == 1


def test_smallest_risk_is_what_is_told_apart_in_words():
    assert LEAST_RISK == acceptance_config("1e-6").risk > LEAST


def test_locate_passes_risk_option_to_the_search(world_file, world_run, tmp_path, monkeypatch):
    """Whose result is none where nothing is that certain."""
    usual, asked = offline.locate, []

    def never_sure(base_map, run, config, progress, guess):
        asked.append(config.acceptance.risk)
        return usual(base_map, run, replace(config, acceptance=NEVER), progress, guess)

    monkeypatch.setattr(offline, "locate", never_sure)
    out = tmp_path / "out"
    command = ["locate", str(world_file), str(world_run), "-o", str(out), "--no-pictures"]
    assert main([*command, "--risk", "1e-6"]) == 1
    assert asked == [1e-6]
    result = json.loads((out / "result.json").read_text())
    assert {each["state"] for each in result["keyframes"]} == {"AMBIGUOUS"}
