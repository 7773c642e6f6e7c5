"""The weights in the package: small enough, and made by what the code says now."""

import json
from dataclasses import asdict

from coview_stream.descriptors.network import CARD, VIEW_NAMES, file_sha256, weights_directory, weights_name
from coview_stream.training.train import DEFAULT

CARD_TEXT = json.loads((weights_directory() / CARD).read_text())


def test_weights_match_card_hashes_and_size_limit() -> None:
    files = [weights_directory() / weights_name(view) for view in VIEW_NAMES]
    assert {path.name: file_sha256(path) for path in files} == CARD_TEXT["sha256"]
    assert CARD_TEXT["same_as"].keys() == set(CARD_TEXT["sha256"].values())
    assert sum(path.stat().st_size for path in files) <= 5_000_000


def test_card_matches_train_command_and_reports_recall_on_held_out_worlds() -> None:
    assert CARD_TEXT["plan"] == json.loads(json.dumps(asdict(DEFAULT)))
    assert CARD_TEXT["command"].startswith("coview-stream train")
    assert CARD_TEXT["data_sha256"]
    judged = CARD_TEXT["validation"]
    assert (judged["worlds"], judged["queries"]) == (DEFAULT.validation, DEFAULT.validation * DEFAULT.most)
    assert judged["AR@1"] > 50 * judged["chance"]
