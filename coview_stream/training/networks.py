"""The two encoders in PyTorch, for the map from above and for a robot's scans, and the files of their weights."""

from __future__ import annotations

import json
from collections.abc import Callable
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
    LAYER_NAMES,
    MIN_ACTIVATION,
    MIN_SIGMA,
    PLACE_REACH,
    PLACE_SIGMA,
    Features,
    file_sha256,
    weights_name,
)
from coview_stream.geometry.arrays import Floats32

VIEWS = ("aerial", "ground")

LOCAL = 32
"""Numbers in a local descriptor; there is one descriptor per square metre."""

PLACE = 128
"""Numbers in a global descriptor."""


class _Conv(nn.Module):
    """A 3 x 3 convolution for both views, with one normalisation per view, as their statistics differ."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.norm = nn.ModuleList([nn.BatchNorm2d(outputs) for _ in VIEWS])

    def forward(self, x: Tensor, view: int) -> Tensor:
        return self.norm[view](self.conv(x))


class _Residual(nn.Module):
    """A residual block of two convolutions."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first, self.second = _Conv(channels, channels), _Conv(channels, channels)

    def forward(self, x: Tensor, view: int) -> Tensor:
        return functional.relu(x + self.second(functional.relu(self.first(x, view)), view))


class _Entry(nn.Module):
    """The separate layers of each view, at 1 m, as crowns from above and stems from below look different."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.stem = _Conv(4 * LAYERS, width)
        self.block = _Residual(width)

    def forward(self, x: Tensor, view: int) -> Tensor:
        return self.block(functional.relu(self.stem(functional.pixel_unshuffle(x, 2), view)), view)


class PlaceNet(nn.Module):
    """Fully convolutional encoder of bird's-eye views to local descriptors, their uncertainty, and global descriptors.

    The input is (B, LAYERS, H, W) in [0, 1], with H and W multiples of 8 and cells of 0.5 m. The outputs are local
    (B, LOCAL, H/2, W/2) of unit norm, sigma (B, 1, H/2, W/2) > 0, and place (B, PLACE, H/8, W/8) of unit norm.
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
        weight = torch.exp(-0.5 * (at / PLACE_SIGMA) ** 2)
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
        sigma = functional.softplus(self.sigma(merged)) + MIN_SIGMA
        # generalised mean (GeM) under a round window around every cell, then a linear layer
        raised = at4.clamp(min=MIN_ACTIVATION).pow(self.power)
        down = functional.conv2d(raised, self.window, padding=(PLACE_REACH, 0), groups=4 * self.width)
        across = self.window.transpose(2, 3)
        raised = functional.conv2d(down, across, padding=(0, PLACE_REACH), groups=4 * self.width)
        place = functional.normalize(self.place(raised.clamp(min=1e-12).pow(1.0 / self.power)), dim=1)
        return local, sigma, place


def _doubled(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def export(net: PlaceNet, directory: Path, card: dict[str, Any]) -> list[Path]:
    """Write one file of weights per view, and the card that records the training; each file atomically.

    The card also has the files' hashes, which identify the view of each.
    """
    directory.mkdir(parents=True, exist_ok=True)
    written = []
    for view, name in enumerate(VIEWS):
        arrays = {"power": net.power.detach().numpy()}
        for layer in LAYER_NAMES:
            arrays[f"{layer}.weight"], arrays[f"{layer}.bias"] = _folded(_module(net, layer, view), view)
        # inputs are bytes, and cells of 0.5 m follow one another
        stem = arrays["stem.weight"] / np.float32(255.0)
        by_cell = stem.reshape(3, 3, LAYERS, 4, -1).swapaxes(2, 3)
        arrays["stem.weight"] = by_cell.reshape(stem.shape)
        path = directory / weights_name(name)
        with atomic_path(path) as part, part.open("wb") as file:
            np.savez(file, **arrays)
        written.append(path)
    card = card | {"sha256": {path.name: file_sha256(path) for path in written}}
    (directory / CARD).write_text(json.dumps(card, indent=1, sort_keys=True) + "\n")
    return written


def _module(net: PlaceNet, layer: str, view: int) -> nn.Module:
    """Return the module of a layer by its name in the file."""
    own = layer.startswith(("stem", "block"))
    module: nn.Module = net.get_submodule(f"entry.{view}.{layer}" if own else layer)
    return module


def _folded(module: Any, view: int) -> tuple[Floats32, Floats32]:
    """Return weights (rows, columns, inputs, outputs) and bias (outputs,) of a convolution and its normalisation."""
    with torch.no_grad():
        if isinstance(module, _Conv):
            norm: Any = module.norm[view]
            scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
            weight, bias = module.conv.weight * scale[:, None, None, None], norm.bias - norm.running_mean * scale
        else:
            weight, bias = module.weight, module.bias
        return weight.permute(2, 3, 1, 0).contiguous().numpy(), bias.numpy()


def encoder(net: PlaceNet, view: str) -> Callable[[Image], Features]:
    """Return the encoder of a view, with the interface of :class:`~coview_stream.descriptors.network.Network`."""

    def encode(image: Image) -> Features:
        with torch.no_grad():
            local, sigma, place = net(torch.from_numpy(image[None].astype("float32") / 255.0), VIEWS.index(view))
        return Features(local[0].numpy(), sigma[0, 0].numpy(), place[0].numpy())

    return encode
