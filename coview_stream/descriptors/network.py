"""Trained encoders of bird's-eye views, run by onnxruntime on the CPU."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from coview_kernels.runtime import workers
from coview_stream.descriptors.birds_eye_view import LAYERS, Image
from coview_stream.errors import ConfigError, DependencyError, InputError, require_library
from coview_stream.geometry.arrays import Floats32

ViewName = Literal["aerial", "ground"]

VIEW_NAMES: tuple[ViewName, ...] = ("aerial", "ground")

OUTPUTS = ("local", "sigma", "place")
"""A network's outputs, in this order."""

CARD = "card.json"
"""File beside the weights with their training and hashes."""

ORIGIN = "of"
"""Metadata of quantised weights: the sha256 of the weights that were quantised."""

LOCAL_CELL = 1.0
"""Edge of a cell of local descriptors, metres."""

PLACE_CELL = 4.0
"""Edge of a cell of global descriptors, metres."""

_MULTIPLE = 8  # image cells
_INPUT = "image"
_REMEDY = "install the package again, or name your own weights' folder in COVIEW_WEIGHTS"


@dataclass(frozen=True)
class Features:
    """A network's outputs for an image (LAYERS, H, W); all three begin at its corner."""

    local: Floats32
    """(C, H / 2, W / 2) of unit norm, independent of heading; cells of 1 m, row along y."""
    sigma: Floats32
    """(H / 2, W / 2) uncertainty of each cell as a keypoint, > 0."""
    place: Floats32
    """(P, H / 8, W / 8) of unit norm: global descriptors of the surroundings of 4 m cells."""


class Network:
    """Encoder of one view, with quantised weights if the directory has some of the same training.

    Args:
        view: the view.
        directory: of the weights; None takes :func:`weights_directory`.
        threads: of onnxruntime.
        exact: never take quantised weights.

    Attributes:
        quantized: whether the weights are quantised.

    Raises:
        InputError: there are no weights in the directory, or they are of another version or another file.
        DependencyError: onnxruntime is not installed, or cannot be loaded.
    """

    def __init__(self, view: ViewName, directory: Path | None = None, threads: int = 1, *, exact: bool = False) -> None:
        runtime = require_library("onnxruntime", "onnxruntime>=1.18", "learned re-localization")
        if not hasattr(runtime, "InferenceSession"):  # an uninstallation may leave an empty folder behind
            raise DependencyError(
                "learned re-localization: onnxruntime is not complete; "
                "pip install --force-reinstall 'onnxruntime>=1.18'"
            )
        path = weights_file(view, directory)
        _check_hash(path)
        options = runtime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = 3
        small = path.with_name(quantized_name(view))
        self.quantized = not exact and small.is_file()
        if self.quantized:
            _check_hash(small)
            self._session = _session(runtime, small, options)
            origin = self._session.get_modelmeta().custom_metadata_map.get(ORIGIN)
            self.quantized = origin == file_sha256(path)
        if not self.quantized:
            self._session = _session(runtime, path, options)

    def __call__(self, image: Image) -> Features:
        """Encode an image (LAYERS, H, W); ValueError unless H and W are multiples of 8 cells, i.e. 4 m."""
        if image.ndim != 3 or image.shape[0] != LAYERS or image.shape[1] % _MULTIPLE or image.shape[2] % _MULTIPLE:
            raise ValueError(f"image {image.shape}: ({LAYERS}, H, W) with H and W multiples of {_MULTIPLE} needed")
        scaled = image[None].astype(np.float32) / np.float32(255.0)
        local, sigma, place = self._session.run(list(OUTPUTS), {_INPUT: scaled})
        return Features(local[0], sigma[0, 0], place[0])


@lru_cache(maxsize=4)
def network(view: ViewName, threads: int | None = None) -> Network:
    """Return the encoder of a view, loaded once, by default with the kernels' number of threads.

    Raises:
        InputError, DependencyError: as :class:`Network`. ConfigError: COVIEW_THREADS is no number.
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
    return f"{view}.onnx"


def quantized_name(view: str) -> str:
    """Return the file name of a view's quantised weights."""
    return f"{view}.int8.onnx"


def file_sha256(path: Path) -> str:
    """Return the sha256 of a small file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _session(runtime: Any, path: Path, options: Any) -> Any:
    """Load weights; InputError unless they are of an encoder of this version."""
    try:
        session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        (image,) = session.get_inputs()
        layers = image.shape[1]
        outputs = tuple(output.name for output in session.get_outputs())
    except Exception as error:  # onnxruntime's errors have no common base that is public
        raise InputError(f"{path}: cannot be loaded as weights; {_REMEDY}") from error
    if (image.name, layers, outputs) != (_INPUT, LAYERS, OUTPUTS):
        raise InputError(f"{path}: weights of another version ({layers} layers); {_REMEDY}")
    return session


def _check_hash(path: Path) -> None:
    """Refuse weights whose hash differs from the card's, if there is one."""
    try:
        expected = json.loads((path.parent / CARD).read_text())["sha256"][path.name]
    except (OSError, ValueError, KeyError, TypeError):
        return
    if file_sha256(path) != expected:
        raise InputError(f"{path}: not the weights that {CARD} beside it names; {_REMEDY}")
