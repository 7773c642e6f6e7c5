"""Settings of the encoders' training; apart from it, for they need no PyTorch."""

from __future__ import annotations

from dataclasses import dataclass

from coview_stream.config.checks import counts, positive


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of the training loop; set by hand.

    Attributes:
        steps: number of batches.
        pieces: maps (136 m) in a batch.
        each: queries in every one.
        rate: of AdamW at first; it falls along a cosine.
        decay: AdamW's weight decay.
        width: the encoder's channels at 1 m.
        wrong: headings that compete with each query's true one.
        seed: of the weights' start and of the batches.
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
