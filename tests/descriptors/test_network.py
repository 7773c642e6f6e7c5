"""The networks in NumPy give the features that onnxruntime gave, on which maps rest, and other ways of computing them.

``features.npz`` has a bird's-eye view of a simulated town and onnxruntime's outputs for the weights as ONNX files: both
networks', local descriptors of every fourth cell, uncertainties of every second.
"""

from pathlib import Path

import numpy as np
import pytest

from coview_stream.descriptors import network as module
from coview_stream.descriptors.network import VIEW_NAMES, Network, ViewName

KNOWN = np.load(Path(__file__).with_name("features.npz"))


@pytest.mark.parametrize("view", VIEW_NAMES)
def test_features_are_those_of_onnxruntime(view: ViewName) -> None:
    features = Network(view)(KNOWN["image"])
    np.testing.assert_allclose(features.local[:, ::4, ::4], KNOWN[f"{view}.local"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(features.sigma[::2, ::2], KNOWN[f"{view}.sigma"], rtol=1e-5)
    np.testing.assert_allclose(features.place, KNOWN[f"{view}.place"], rtol=0, atol=1e-5)


def test_threads_and_strips_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = Network("ground")(KNOWN["image"])
    for threads, strip in ((3, 1 << 18), (1, 1), (1, 1 << 30)):
        monkeypatch.setattr(module, "_STRIP", strip)
        features = Network("ground", threads=threads)(KNOWN["image"])
        for name in ("local", "sigma", "place"):
            np.testing.assert_allclose(getattr(features, name), getattr(expected, name), atol=1e-5)


@pytest.mark.parametrize("shape", [(11, 64), (10, 64, 64), (11, 64, 60)])
def test_images_of_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="multiples of 8"):
        Network("ground")(np.zeros(shape, dtype=np.uint8))
