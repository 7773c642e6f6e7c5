"""Trained networks as ONNX files, which need no PyTorch to run."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from coview_stream.learn.net import VIEWS, OneView, PlaceNet
from coview_stream.place.learned.bird_view import LAYERS, Image
from coview_stream.place.learned.network import CARD, OUTPUTS, Features, file_sha256, weights_name

_OPSET = 17
_SAMPLE = 128  # cells of the image that is traced; all sizes that are multiples of 8 work


def export(net: PlaceNet, directory: Path, card: dict[str, Any]) -> list[Path]:
    """Write one ONNX file per view and the card that says how they were made; a file is complete or not there.

    The card also names the files' hashes, by which one view's weights are told from the other's.
    """
    directory.mkdir(parents=True, exist_ok=True)
    written = []
    for view, name in enumerate(VIEWS):
        single = OneView(net, view).eval()
        path = directory / weights_name(name)
        partial = path.with_suffix(f".{os.getpid()}.part")
        image = torch.zeros(1, LAYERS, _SAMPLE, _SAMPLE)
        sizes = {"image": {2: "height", 3: "width"}}
        sizes |= {output: {2: f"{output}_height", 3: f"{output}_width"} for output in OUTPUTS}
        torch.onnx.export(
            single, (image,), str(partial), input_names=["image"], output_names=list(OUTPUTS),
            dynamic_axes=sizes, opset_version=_OPSET, dynamo=False,
        )  # fmt: skip
        partial.replace(path)
        written.append(path)
    card = card | {"sha256": {path.name: file_sha256(path) for path in written}}
    text = json.dumps(card, indent=1, sort_keys=True) + "\n"
    (directory / CARD).write_text(text)
    return written


def encoder(net: PlaceNet, view: str) -> Callable[[Image], Features]:
    """Return a network in training as what :class:`~.network.Network` is once it has been exported."""

    def encode(image: Image) -> Features:
        with torch.no_grad():
            local, sigma, place = net(
                torch.from_numpy(image[None].astype("float32") / 255.0), VIEWS.index(view)
            )
        return Features(local[0].numpy(), sigma[0, 0].numpy(), place[0].numpy())

    return encode
