"""Exported networks: the card names each view's file, so that one is not taken for the other."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch: pip install '.[learn-train]'")

from coview_stream.descriptors.birds_eye_view import LAYERS
from coview_stream.descriptors.network import CARD, Network, file_sha256
from coview_stream.errors import InputError
from coview_stream.training.networks import PlaceNet, encoder, export


def test_exported_card_names_each_weights_file(tmp_path: Path) -> None:
    net = PlaceNet(width=4).eval()
    card = {"steps": 7}
    written = export(net, tmp_path, card)
    noted = json.loads((tmp_path / CARD).read_text())
    assert noted == {"steps": 7, "sha256": {path.name: file_sha256(path) for path in written}}
    assert card == {"steps": 7}
    image = np.random.default_rng(0).integers(0, 256, (LAYERS, 64, 96)).astype(np.uint8)
    np.testing.assert_allclose(Network("ground", tmp_path)(image).local, encoder(net, "ground")(image).local, atol=1e-4)
    shutil.copy(tmp_path / "aerial.npz", tmp_path / "ground.npz")
    with pytest.raises(InputError, match="not the weights that card"):
        Network("ground", tmp_path)
