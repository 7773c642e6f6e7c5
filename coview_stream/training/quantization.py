"""Static quantisation of an exported encoder to eight bits, in which a CPU runs it in less than half the time."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.descriptors.birds_eye_view import Image
from coview_stream.descriptors.network import CARD, ORIGIN, file_sha256, quantized_name, weights_file
from coview_stream.errors import require_library

_LAYERS = ("Conv", "Add", "Relu")  # the rest takes no time


def quantize(directory: Path, images: Iterable[Image], note: str) -> Path:
    """Quantise the ground network in a directory of weights; the file is written beside it, and named by the card.

    Activations have eight bits in the range that the images cause, weights seven, one scale for each channel: sums
    of eight would overflow on CPUs without VNNI. The aerial network is not quantised: maps are built once.

    Args:
        directory: with the weights and their card.
        images: (LAYERS, H, W) of scans as they will be seen, a hundred or so.
        note: what they are, for the card.

    Raises:
        InputError: there are no weights. DependencyError: ONNX is not installed.
    """
    onnx = require_library("onnx", "onnx>=1.16", "quantisation (extra learn-train)")
    from onnxruntime import quantization as tools
    from onnxruntime.quantization.shape_inference import quant_pre_process

    class Images(tools.CalibrationDataReader):
        def __init__(self) -> None:
            self._left: Iterator[Image] = iter(images)

        def get_next(self) -> dict[str, Any] | None:
            image = next(self._left, None)
            return None if image is None else {"image": image[None].astype(np.float32) / np.float32(255.0)}

    weights = weights_file("ground", directory)
    written = directory / quantized_name("ground")
    with tempfile.TemporaryDirectory() as folder, atomic_path(written) as part:
        prepared = Path(folder) / "prepared.onnx"
        quant_pre_process(str(weights), str(prepared), skip_symbolic_shape=True)
        tools.quantize_static(
            str(prepared), str(part), Images(), quant_format=tools.QuantFormat.QDQ, per_channel=True,
            reduce_range=True, op_types_to_quantize=list(_LAYERS), activation_type=tools.QuantType.QUInt8,
            weight_type=tools.QuantType.QInt8, nodes_to_exclude=_delicate(onnx.load(str(prepared)).graph),
        )  # fmt: skip
        model = onnx.load(str(part))
        onnx.helper.set_model_props(model, {ORIGIN: file_sha256(weights)})
        onnx.save(model, str(part))
    card = json.loads((directory / CARD).read_text())
    card["sha256"][written.name] = file_sha256(written)
    card["quantized"] = note
    (directory / CARD).write_text(json.dumps(card, indent=1, sort_keys=True) + "\n")
    return written


def _delicate(graph: Any) -> list[str]:
    """Name the nodes behind a power or a softplus, and what a softplus is of: numbers of too many magnitudes."""
    names: list[str] = []
    tensors: set[str] = set()
    steep = {name for node in graph.node if node.op_type == "Softplus" for name in node.input}
    for node in graph.node:  # in order
        if node.op_type in ("Pow", "Softplus") or tensors.intersection(node.input):
            tensors.update(node.output)
            names.append(str(node.name))
        elif steep.intersection(node.output):
            names.append(str(node.name))
    return names
