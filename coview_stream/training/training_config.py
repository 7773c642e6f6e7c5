"""Settings of the encoders' training; apart from it, for they need no PyTorch."""

from __future__ import annotations

from dataclasses import dataclass

from coview_stream.config.checks import counts, positive


@dataclass(frozen=True)
class TrainingConfig:
    """How the encoders are trained.

    ``steps`` batches of ``pieces`` maps (136 m) with ``each`` queries in every one; AdamW with a learning rate that
    falls along a cosine from ``rate``. ``width`` is the encoder's channels at 1 m. ``wrong`` headings compete with each
    query's true one.
    """

    steps: int = 600
    pieces: int = 4
    each: int = 5
    rate: float = 3e-3
    decay: float = 1e-4
    width: int = 24
    wrong: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        counts(self, "steps", "pieces", "each", "width", "wrong")
        counts(self, "seed", minimum=0)
        positive(self, "rate", "decay")
