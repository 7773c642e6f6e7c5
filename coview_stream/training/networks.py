"""The two encoders in PyTorch, of the map from above and of a robot's scans; their export to ONNX, quantisation."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.descriptors.birds_eye_view import LAYERS, Image
from coview_stream.descriptors.network import (
    CARD,
    ORIGIN,
    OUTPUTS,
    Features,
    file_sha256,
    quantized_name,
    weights_file,
    weights_name,
)
from coview_stream.errors import require_library

VIEWS = ("aerial", "ground")

LOCAL = 32
"""Numbers in a local descriptor (one per square metre)."""

PLACE = 128
"""Numbers in a global descriptor."""

PLACE_REACH = 7
"""Cells of 4 m about the middle that a global descriptor pools, under a Gaussian window of 14 m: up to 28 m."""

_PLACE_SIGMA = 3.5  # cells of 4 m
_MIN_SIGMA = 0.05
_MIN_ACTIVATION = 1e-4  # before GeM's power
_OPSET = 17  # of ONNX
_SAMPLE = 128  # cells of the image that is traced; all sizes that are multiples of 8 work


class _Conv(nn.Module):
    """A 3 x 3 convolution shared by both views, with a normalisation for each: their statistics differ."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.norm = nn.ModuleList([nn.BatchNorm2d(outputs) for _ in VIEWS])

    def forward(self, x: Tensor, view: int) -> Tensor:
        return self.norm[view](self.conv(x))


class _Residual(nn.Module):
    """Two convolutions whose result is added to their input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first, self.second = _Conv(channels, channels), _Conv(channels, channels)

    def forward(self, x: Tensor, view: int) -> Tensor:
        return functional.relu(x + self.second(functional.relu(self.first(x, view)), view))


class _Entry(nn.Module):
    """The layers that each view has for itself, at 1 m: crowns from above and stems from below look different."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.stem = _Conv(4 * LAYERS, width)
        self.block = _Residual(width)

    def forward(self, x: Tensor, view: int) -> Tensor:
        return self.block(functional.relu(self.stem(functional.pixel_unshuffle(x, 2), view)), view)


class PlaceNet(nn.Module):
    """Encoder of bird's-eye views: local descriptors, their uncertainty, global descriptors; fully convolutional.

    Input (B, LAYERS, H, W) in [0, 1], H and W multiples of 8; cells of 0.5 m. Output: local (B, LOCAL, H/2, W/2) of
    unit norm, sigma (B, 1, H/2, W/2) > 0, place (B, PLACE, H/8, W/8) of unit norm.
    """

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        self.width = width
        self.entry = nn.ModuleList([_Entry(width) for _ in VIEWS])
        self.down2, self.down4 = _Conv(width, 2 * width, 2), _Conv(2 * width, 4 * width, 2)
        self.at2 = nn.ModuleList([_Residual(2 * width) for _ in range(2)])
        self.at4 = nn.ModuleList([_Residual(4 * width) for _ in range(2)])
        self.lateral = nn.ModuleList([nn.Conv2d(k * width, LOCAL, 1) for k in (1, 2, 4)])
        self.local = nn.Conv2d(LOCAL, LOCAL, 3, 1, 1)
        self.sigma = nn.Conv2d(LOCAL, 1, 1)
        self.power = nn.Parameter(torch.tensor(3.0))
        self.place = nn.Conv2d(4 * width, PLACE, 1)
        self.window: Tensor
        at = torch.arange(-PLACE_REACH, PLACE_REACH + 1, dtype=torch.float32)
        weight = torch.exp(-0.5 * (at / _PLACE_SIGMA) ** 2)
        window = (weight / weight.sum())[:, None].repeat(4 * width, 1, 1, 1)
        self.register_buffer("window", window, persistent=False)

    def forward(self, x: Tensor, view: int) -> tuple[Tensor, Tensor, Tensor]:
        """Encode images of one view, an index into ``VIEWS``."""
        at1 = self.entry[view](x, view)
        at2 = functional.relu(self.down2(at1, view))
        for block in self.at2:
            at2 = block(at2, view)
        at4 = functional.relu(self.down4(at2, view))
        for block in self.at4:
            at4 = block(at4, view)
        merged = self.lateral[1](at2) + _doubled(self.lateral[2](at4))
        merged = functional.relu(self.lateral[0](at1) + _doubled(merged))
        local = functional.normalize(self.local(merged), dim=1)
        sigma = functional.softplus(self.sigma(merged)) + _MIN_SIGMA
        # the generalised mean (GeM) under a round window about every cell, then a linear layer
        raised = at4.clamp(min=_MIN_ACTIVATION).pow(self.power)
        down = functional.conv2d(raised, self.window, padding=(PLACE_REACH, 0), groups=4 * self.width)
        across = self.window.transpose(2, 3)
        raised = functional.conv2d(down, across, padding=(0, PLACE_REACH), groups=4 * self.width)
        place = functional.normalize(self.place(raised.clamp(min=1e-12).pow(1.0 / self.power)), dim=1)
        return local, sigma, place


class OneView(nn.Module):
    """The network for one view, in the form that is exported."""

    def __init__(self, net: PlaceNet, view: int) -> None:
        super().__init__()
        self.net, self.view = net, view

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Encode images of this view."""
        encoded: tuple[Tensor, Tensor, Tensor] = self.net(x, self.view)
        return encoded


def _doubled(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def export(net: PlaceNet, directory: Path, card: dict[str, Any]) -> list[Path]:
    """Write one ONNX file per view and the card that records how they were made; a file is complete or absent.

    The card also holds the files' hashes, which tell one view's weights from the other's.
    """
    directory.mkdir(parents=True, exist_ok=True)
    written = []
    for view, name in enumerate(VIEWS):
        single = OneView(net, view).eval()
        path = directory / weights_name(name)
        image = torch.zeros(1, LAYERS, _SAMPLE, _SAMPLE)
        sizes = {"image": {2: "height", 3: "width"}}
        sizes |= {output: {2: f"{output}_height", 3: f"{output}_width"} for output in OUTPUTS}
        with atomic_path(path) as part:
            torch.onnx.export(
                single, (image,), str(part), input_names=["image"], output_names=list(OUTPUTS),
                dynamic_axes=sizes, opset_version=_OPSET, dynamo=False,
            )  # fmt: skip
        written.append(path)
    card = card | {"sha256": {path.name: file_sha256(path) for path in written}}
    (directory / CARD).write_text(json.dumps(card, indent=1, sort_keys=True) + "\n")
    return written


def encoder(net: PlaceNet, view: str) -> Callable[[Image], Features]:
    """Return a network in training with the interface of the exported :class:`~.descriptors.network.Network`."""

    def encode(image: Image) -> Features:
        with torch.no_grad():
            local, sigma, place = net(torch.from_numpy(image[None].astype("float32") / 255.0), VIEWS.index(view))
        return Features(local[0].numpy(), sigma[0, 0].numpy(), place[0].numpy())

    return encode


_LAYERS = ("Conv", "Add", "Relu")  # the rest takes no time


def quantize(directory: Path, images: Iterable[Image], note: str) -> Path:
    """Quantise the ground network in a directory of weights; write the result there and name it in the card.

    Activations have eight bits in the range that the images cause, weights seven, one scale for each channel: sums
    of eight would overflow on CPUs without VNNI. The aerial network is not quantised: maps are built once.

    ``directory`` holds the weights and their card, which takes the ``note`` on the images: a hundred typical scans
    (LAYERS, H, W). Raises InputError without weights, DependencyError without ONNX.
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
    """Name the nodes behind a power or softplus and the inputs of a softplus: numbers of too many magnitudes."""
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
