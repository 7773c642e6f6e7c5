"""The quantised ground network says what the exact one says, and serves only the weights that it was made of."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from coview_stream.descriptors.birds_eye_view import birds_eye_view
from coview_stream.descriptors.network import CARD, Network, file_sha256, weights_directory


@pytest.fixture
def image(map_points: np.ndarray) -> np.ndarray:
    return birds_eye_view(map_points.astype(np.float32), np.array([-32.0, -32.0]), (128, 128))


def test_quantized_features_are_nearly_the_same(image: np.ndarray) -> None:
    quantized, exact = Network("ground"), Network("ground", exact=True)
    assert quantized.quantized
    assert not exact.quantized
    ours, known = quantized(image), exact(image)
    likeness = (ours.local * known.local).sum(axis=0)
    assert likeness.mean() > 0.99
    assert np.quantile(likeness, 0.05) > 0.95
    assert (ours.place * known.place).sum(axis=0).mean() > 0.99
    assert ours.sigma.min() > 0.04
    assert np.quantile(np.abs(ours.sigma / known.sigma - 1.0), 0.95) < 0.2


def test_maps_are_built_with_exact_weights() -> None:
    assert not Network("aerial").quantized


def test_quantized_weights_of_others_are_not_taken(tmp_path: Path) -> None:
    for file in weights_directory().iterdir():
        shutil.copy(file, tmp_path / file.name)
    assert Network("ground", tmp_path).quantized
    shutil.copy(tmp_path / "aerial.onnx", tmp_path / "ground.onnx")
    card = json.loads((tmp_path / CARD).read_text())
    card["sha256"]["ground.onnx"] = file_sha256(tmp_path / "ground.onnx")
    (tmp_path / CARD).write_text(json.dumps(card))
    assert not Network("ground", tmp_path).quantized
