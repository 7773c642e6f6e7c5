"""The weights in the package: small enough, and made by what the code says now."""

from __future__ import annotations

import json
from dataclasses import asdict

from coview_stream.descriptors.network import CARD, VIEW_NAMES, file_sha256, shipped, weights_name
from coview_stream.training.train import USUAL

CARD_TEXT = json.loads((shipped() / CARD).read_text())


def test_weights_are_those_of_the_card_and_take_five_megabytes_at_most() -> None:
    files = [shipped() / weights_name(view) for view in VIEW_NAMES]
    assert {path.name: file_sha256(path) for path in files} == CARD_TEXT["sha256"]
    assert sum(path.stat().st_size for path in files) <= 5_000_000


def test_the_card_says_what_the_command_would_do() -> None:
    assert CARD_TEXT["plan"] == json.loads(json.dumps(asdict(USUAL)))
    assert CARD_TEXT["command"].startswith("coview-stream train")
    assert CARD_TEXT["data_sha256"]


def test_the_card_tells_how_well_they_did_on_worlds_held_out() -> None:
    judged = CARD_TEXT["validation"]
    assert judged["worlds"] == USUAL.validation
    assert judged["queries"] == USUAL.validation * USUAL.most
    assert judged["AR@1"] > 50 * judged["chance"]
