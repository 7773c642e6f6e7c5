"""The trained encoders, run by onnxruntime on the CPU."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from coview_stream.errors import InputError
from coview_stream.extras import extra
from coview_stream.place.learned.bird_view import LAYERS, Image

View = Literal["aerial", "ground"]

OUTPUTS = ("local", "sigma", "place")
"""What a network gives, in this order."""

CARD = "card.json"
"""The file beside the weights that says how they were made."""

LOCAL_CELL = 1.0
"""Edge of a cell of local descriptors, metres."""

PLACE_CELL = 4.0
"""Edge of a cell of global descriptors, metres."""

_MULTIPLE = 8  # image cells


@dataclass(frozen=True)
class Features:
    """What a network makes of an image whose corner is the corner of all three.

    Attributes:
        local: (C, H / 2, W / 2) float32 of unit norm, independent of heading; cells of 1 m, row along y.
        sigma: (H / 2, W / 2) float32, how uncertain a cell is as a keypoint, > 0.
        place: (P, H / 8, W / 8) float32 of unit norm: global descriptor of what lies around each 4 m cell.
    """

    local: npt.NDArray[np.float32]
    sigma: npt.NDArray[np.float32]
    place: npt.NDArray[np.float32]


class Network:
    """The encoder of one view.

    Raises:
        InputError: there are no weights in the directory, or they are not of this version.
        DependencyError: onnxruntime is not installed.
    """

    def __init__(self, view: View, directory: Path | None = None, threads: int = 1) -> None:
        runtime = extra("onnxruntime", "onnxruntime", "learned re-localization")
        path = (directory or shipped()) / weights_name(view)
        if not path.is_file():
            raise InputError(
                f"{path}: no weights of the {view} network; train them with 'coview-stream train'"
            )
        options = runtime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = 3
        try:
            self._session: Any = runtime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime's errors have no common base that is public
            raise InputError(f"{path}: cannot be loaded as weights; train them again") from error
        shape = self._session.get_inputs()[0].shape
        names = tuple(output.name for output in self._session.get_outputs())
        if shape[1] != LAYERS or names != OUTPUTS:
            raise InputError(f"{path}: weights of another version ({shape[1]} layers); train them again")

    def __call__(self, image: Image) -> Features:
        """Encode an image (LAYERS, H, W); H and W are multiples of 8 cells, i.e. 4 m.

        Raises:
            ValueError: the image has another shape.
        """
        if (
            image.ndim != 3
            or image.shape[0] != LAYERS
            or image.shape[1] % _MULTIPLE
            or image.shape[2] % _MULTIPLE
        ):
            raise ValueError(
                f"image {image.shape}: ({LAYERS}, H, W) with H and W multiples of {_MULTIPLE} needed"
            )
        scaled = image[None].astype(np.float32) / np.float32(255.0)
        local, sigma, place = self._session.run(list(OUTPUTS), {"image": scaled})
        return Features(local[0], sigma[0, 0], place[0])


@lru_cache(maxsize=4)
def network(view: View, directory: Path | None = None) -> Network:
    """Return the encoder of a view, loaded once."""
    return Network(view, directory, int(os.environ.get("COVIEW_THREADS", "0") or 0))


def shipped() -> Path:
    """Return the directory of the weights that come with the package."""
    return Path(__file__).parent / "weights"


def weights_name(view: str) -> str:
    """Return the file name of a view's weights."""
    return f"{view}.onnx"
