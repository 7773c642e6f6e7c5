"""Trained encoders of bird's-eye views: their weight files, and their forward pass in NumPy.

Images have their channels last here, (H, W, C), so that a convolution is one matrix product per strip of rows: the
3 x 3 cells around each cell, copied side by side, times the weights. The input image of a convolution has a border of
one cell of zeros.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.lib.stride_tricks import as_strided

from coview_kernels.runtime import workers
from coview_stream.descriptors.birds_eye_view import LAYERS, Image
from coview_stream.errors import ConfigError, InputError
from coview_stream.geometry.arrays import Floats32

ViewName = Literal["aerial", "ground"]

VIEW_NAMES: tuple[ViewName, ...] = ("aerial", "ground")

CARD = "card.json"
"""File beside the weights with their training and hashes."""

LOCAL_CELL = 1.0
"""Edge of a cell of local descriptors, metres."""

PLACE_CELL = 4.0
"""Edge of a cell of global descriptors, metres."""

PLACE_REACH = 7
"""Cells of 4 m to either side, thus 28 m, over which a global descriptor pools under a Gaussian window of 14 m."""

PLACE_SIGMA = 3.5
"""Standard deviation of that window, cells of 4 m."""

MIN_SIGMA = 0.05
"""Least uncertainty of a cell."""

MIN_ACTIVATION = 1e-4
"""Lower limit of activations that the generalised mean (GeM) raises to its power."""

_MULTIPLE = 8  # image cells, of which height and width are multiples
_STRIP = 1 << 18  # numbers in a strip's copied cells, 1 MB, which stays in the cache of a core
_TINY = np.float32(1e-12)  # lower limit of divisors and powers
_REMEDY = "install the package again, or name your own weights' folder in COVIEW_WEIGHTS"

_Run = Callable[[Callable[[int], None], Iterable[int]], Iterable[None]]  # map, or that of a pool


@dataclass(frozen=True)
class Features:
    """A network's outputs for an image (LAYERS, H, W); all three start at its corner."""

    local: Floats32  # (C, H / 2, W / 2) of unit norm, independent of heading; cells of 1 m, row along y
    sigma: Floats32  # (H / 2, W / 2) uncertainty of each cell as a keypoint, > 0
    place: Floats32  # (P, H / 8, W / 8) of unit norm: global descriptors of the surroundings of 4 m cells


class Network:
    """Encoder of one view, the exported half of :class:`coview_stream.training.networks.PlaceNet`.

    Weights come from ``directory``, by default :func:`weights_directory`. ``threads`` share the strips of a
    convolution; their number does not affect results.

    Raises:
        InputError: the directory has no weights, or those of another version or another file.
    """

    def __init__(self, view: ViewName, directory: Path | None = None, threads: int = 1) -> None:
        path = weights_file(view, directory)
        _check_hash(path)
        self._threads = threads
        try:
            with np.load(path, allow_pickle=False) as arrays:
                self._power = np.float32(arrays["power"])
                self._layers = {name: _Layer(arrays[f"{name}.weight"], arrays[f"{name}.bias"]) for name in LAYER_NAMES}
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"{path}: cannot be loaded as weights; {_REMEDY}") from error
        layers = self._layers["stem"].weight.shape[2] // 4
        if layers != LAYERS:
            raise InputError(f"{path}: weights of another version ({layers} layers); {_REMEDY}")
        try:
            self._encode(np.zeros((LAYERS, _MULTIPLE, _MULTIPLE), dtype=np.uint8), map)
        except ValueError as error:
            raise InputError(f"{path}: its layers do not fit each other ({error}); {_REMEDY}") from error

    def __call__(self, image: Image) -> Features:
        """Encode an image (LAYERS, H, W); ValueError unless H and W are multiples of 8 cells, i.e. 4 m."""
        if image.ndim != 3 or image.shape[0] != LAYERS or image.shape[1] % _MULTIPLE or image.shape[2] % _MULTIPLE:
            raise ValueError(f"image {image.shape}: ({LAYERS}, H, W) with H and W multiples of {_MULTIPLE} needed")
        if self._threads == 1:
            return self._encode(image, map)
        with ThreadPoolExecutor(self._threads) as pool:
            return self._encode(image, pool.map)

    def _encode(self, image: Image, run: _Run) -> Features:
        layer = self._layers
        at1 = self._residual("block", layer["stem"].convolve(_unshuffled(image), run), run)
        at2 = layer["down2"].convolve(at1, run, stride=2)
        at2 = self._residual("at2.1", self._residual("at2.0", at2, run), run)
        at4 = layer["down4"].convolve(at2, run, stride=2)
        at4 = self._residual("at4.1", self._residual("at4.0", at4, run), run)
        merged = _doubled(layer["lateral.2"].project(_inner(at4)))
        merged += layer["lateral.1"].project(_inner(at2))
        merged = _doubled(merged)
        merged += layer["lateral.0"].project(_inner(at1))
        del at1, at2
        top = np.zeros((merged.shape[0] + 2, merged.shape[1] + 2, merged.shape[2]), dtype=np.float32)
        np.maximum(merged, 0.0, out=_inner(top))
        sigma = layer["sigma"].project(_inner(top))[..., 0]
        sigma = np.log1p(np.exp(-np.abs(sigma))) + np.maximum(sigma, 0.0) + np.float32(MIN_SIGMA)
        local = _inner(layer["local"].convolve(top, run, rectify=False))
        place = layer["place"].project(_pooled(_inner(at4), self._power))
        return Features(_unit(local).transpose(2, 0, 1), sigma, _unit(place).transpose(2, 0, 1))

    def _residual(self, name: str, x: Floats32, run: _Run) -> Floats32:
        inside = self._layers[f"{name}.first"].convolve(x, run)
        return self._layers[f"{name}.second"].convolve(inside, run, add=x)


LAYER_NAMES = (
    "stem", "block.first", "block.second",
    "down2", "at2.0.first", "at2.0.second", "at2.1.first", "at2.1.second",
    "down4", "at4.0.first", "at4.0.second", "at4.1.first", "at4.1.second",
    "lateral.0", "lateral.1", "lateral.2", "local", "sigma", "place",
)  # fmt: skip
"""Convolutions, whose weights (rows, columns, inputs, outputs) and biases (outputs) a file contains, with ``power``.

They include normalisations. The stem takes bytes; its inputs are the layers of four cells of 0.5 m, row by row.
"""


@dataclass(frozen=True)
class _Layer:
    """A convolution of 1 or 3 x 3 cells; ValueError for inconsistent arrays."""

    weight: Floats32
    bias: Floats32

    def __post_init__(self) -> None:
        if self.weight.shape[:2] not in ((1, 1), (3, 3)) or self.weight.shape[3:] != self.bias.shape:
            raise ValueError(f"weights {self.weight.shape} and biases {self.bias.shape} are of no convolution")

    def project(self, x: Floats32) -> Floats32:
        """Multiply the channels of each cell of an image (H, W, C) by the weights of a single cell."""
        y: Floats32 = x @ self.weight[0, 0]
        y += self.bias
        return y

    def convolve(
        self, x: Floats32, run: _Run, *, stride: int = 1, add: Floats32 | None = None, rectify: bool = True
    ) -> Floats32:
        """Convolve with 3 x 3 cells, add ``add`` (bordered) and rectify; input and output have a border."""
        channels, outputs = self.weight.shape[2:]
        if x.shape[2] != channels:
            raise ValueError(f"an image of {x.shape[2]} channels, weights of {channels}")
        height, width = ((n - 2) // stride for n in x.shape[:2])
        down, right, _ = x.strides
        around = as_strided(
            x, (height, width, 3, 3 * channels), (down * stride, right * stride, down, x.itemsize), writeable=False
        )
        weight = self.weight.reshape(-1, outputs)
        whole = np.zeros((height + 2, width + 2, outputs), dtype=np.float32)
        rows = max(1, _STRIP // (width * len(weight)))

        def strip(row: int) -> None:
            cells = around[row : row + rows]
            y = (np.ascontiguousarray(cells).reshape(-1, len(weight)) @ weight).reshape(-1, width, outputs)
            y += self.bias
            if add is not None:
                y += _inner(add)[row : row + rows]
            into = _inner(whole)[row : row + rows]
            if rectify:
                np.maximum(y, 0.0, out=into)
            else:
                into[...] = y

        for _ in run(strip, range(0, height, rows)):
            pass
        return whole


def _inner(x: Floats32) -> Floats32:
    """Return an image without its border."""
    return x[1:-1, 1:-1]


def _unshuffled(image: Image) -> Floats32:
    """Stack the layers of 2 x 2 cells of an image (LAYERS, H, W) in one cell, and add a border."""
    layers, height, width = (image.shape[0], image.shape[1] // 2, image.shape[2] // 2)
    rows = np.ascontiguousarray(image.transpose(1, 2, 0)).reshape(height, 2, width, 2 * layers)
    x = np.zeros((height + 2, width + 2, 4 * layers), dtype=np.float32)
    _inner(x)[..., : 2 * layers], _inner(x)[..., 2 * layers :] = rows[:, 0], rows[:, 1]
    return x


def _doubled(x: Floats32) -> Floats32:
    """Interpolate an image (H, W, C) linearly to (2 H, 2 W, C)."""
    for axis in (0, 1):
        rows = x.swapaxes(0, axis)
        part = np.float32(0.25) * np.concatenate([rows[:1], rows, rows[-1:]])
        both = np.stack([part[:-2], part[2:]], axis=1)
        both += np.float32(0.75) * rows[:, None]
        x = both.reshape(-1, *rows.shape[1:]).swapaxes(0, axis)
    return x


def _pooled(x: Floats32, power: np.float32) -> Floats32:
    """Average an image (H, W, C) under the Gaussian window around each cell, by the generalised mean (GeM)."""
    raised = np.maximum(x, np.float32(MIN_ACTIVATION)) ** power
    height, width, _ = raised.shape
    raised = (_window(height) @ raised.reshape(height, -1)).reshape(raised.shape)
    raised = _window(width) @ raised
    return np.asarray(np.maximum(raised, _TINY) ** (np.float32(1.0) / power))


def _window(size: int) -> Floats32:
    """Return the matrix (size, size) that averages a row of cells under the Gaussian window, with zeros beyond them."""
    away = np.abs(np.arange(size)[:, None] - np.arange(size))
    weight = np.exp(-0.5 * (np.arange(-PLACE_REACH, PLACE_REACH + 1) / PLACE_SIGMA) ** 2)
    inside = away <= PLACE_REACH
    return np.where(inside, np.exp(-0.5 * (away / PLACE_SIGMA) ** 2) / weight.sum(), 0.0).astype(np.float32)


def _unit(x: Floats32) -> Floats32:
    """Scale each cell's channels (H, W, C) to a norm of 1, in place."""
    norm = np.sqrt(np.einsum("hwc,hwc->hw", x, x))
    x /= np.maximum(norm, _TINY)[..., None]
    return x


@lru_cache(maxsize=4)
def network(view: ViewName, threads: int | None = None) -> Network:
    """Return the encoder of a view, loaded once, by default with the kernels' number of threads.

    Raises:
        InputError: as :class:`Network`. ConfigError: COVIEW_THREADS is not a number.
    """
    if threads is None:
        try:
            threads = workers()
        except ValueError as error:
            raise ConfigError(str(error)) from error
    return Network(view, threads=threads)


def weights_directory() -> Path:
    """Return the directory of the weights: ``COVIEW_WEIGHTS`` if set, else the package's."""
    folder = os.environ.get("COVIEW_WEIGHTS")
    return Path(folder) if folder else Path(__file__).parent / "weights"


def weights_file(view: ViewName, directory: Path | None = None) -> Path:
    """Return the path of a view's weights; InputError if there are none."""
    path = (directory or weights_directory()) / weights_name(view)
    if not path.is_file():
        raise InputError(f"{path}: no weights of the {view} network; {_REMEDY}")
    return path


def weights_name(view: str) -> str:
    """Return the file name of a view's weights."""
    return f"{view}.npz"


def weights_id(path: Path) -> str:
    """Return the sha256 of a weight file or, if the file was converted, of the original that the card names.

    Maps store it, so that features of weights in another form count as the same.
    """
    name = file_sha256(path)
    same = _card(path).get("same_as", {})
    return str(same.get(name, name)) if isinstance(same, dict) else name


def file_sha256(path: Path) -> str:
    """Return the sha256 of a small file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _check_hash(path: Path) -> None:
    """Refuse weights whose hash differs from the card's, if any."""
    hashes = _card(path).get("sha256", {})
    expected = hashes.get(path.name) if isinstance(hashes, dict) else None
    if expected is not None and file_sha256(path) != expected:
        raise InputError(f"{path}: not the weights that {CARD} beside it names; {_REMEDY}")


def _card(path: Path) -> dict[str, Any]:
    """Return the card beside a file of weights, empty if there is none."""
    try:
        card = json.loads((path.parent / CARD).read_text())
    except (OSError, ValueError):
        return {}
    return card if isinstance(card, dict) else {}
