"""A minute's training of tiny networks: the loss falls, and places are found far more often than by chance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch: pip install '.[learn-train]'")
pytest.importorskip("onnx", reason="training needs ONNX: pip install '.[learn-train]'")

from coview_stream.cli import main
from coview_stream.learn.session import SMOKE, train_session
from coview_stream.place.learned.bird_view import LAYERS
from coview_stream.place.learned.network import Network


def test_smoke_training_learns_to_find_places(tmp_path: Path) -> None:
    card = train_session(tmp_path, SMOKE)
    assert card["loss"]["last"] < 0.6 * card["loss"]["first"]
    assert card["validation"]["AR@1"] >= 5 * card["validation"]["chance"]
    image = np.full((LAYERS, 128, 128), 128, dtype=np.uint8)
    for view in ("aerial", "ground"):
        features = Network(view, tmp_path)(image)  # type: ignore[arg-type] # a literal, by name
        assert np.allclose(np.linalg.norm(features.local, axis=0), 1.0, atol=1e-4)
        assert (features.sigma > 0).all()


def test_worlds_held_out_cannot_be_trained_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", str(tmp_path), "--smoke", "--first-world", "18999"]) == 2
    assert "held out" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())
