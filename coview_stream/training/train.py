"""One training from end to end: worlds, training, weights, and a card that says what they are worth."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.config.checks import counts
from coview_stream.errors import ConfigError, InputError, require_library
from coview_stream.training.dataset import WorldViews, read_world, write_dataset
from coview_stream.training.recipe import Recipe
from coview_stream.training.training_config import TrainingConfig
from coview_stream.version import __version__

_EVERY = 20  # steps from one line to the next
_HELD_OUT = 19_000  # first seed of the worlds that training never sees

Say = Callable[[str], None]


@dataclass(frozen=True)
class Plan:
    """What to train on and how.

    Attributes:
        worlds: how many; their seeds follow each other from ``first``.
        validation: worlds of other seeds, on which the result is judged.
        most: queries judged in each of them.
        recipe: what worlds are drawn from.
        training: how the encoders are trained.
    """

    worlds: int = 62
    first: int = 10_000
    validation: int = 8
    most: int = 60
    recipe: Recipe = field(default_factory=Recipe)
    training: TrainingConfig = field(default_factory=TrainingConfig)

    def __post_init__(self) -> None:
        counts(self, "worlds", "validation", "most")
        if self.first < 0 or self.seeds[-1] >= _HELD_OUT:
            raise ConfigError(
                f"worlds {self.first} to {self.seeds[-1]}: seeds from 0 to {_HELD_OUT - 1} may be trained on, those "
                "beyond are held out"
            )

    @property
    def seeds(self) -> range:
        """Seeds of the worlds to train on."""
        return range(self.first, self.first + self.worlds)

    @property
    def held_out(self) -> range:
        """Seeds of the worlds to judge on."""
        return range(_HELD_OUT, _HELD_OUT + self.validation)

    def changed(self, worlds: int | None, steps: int | None, first: int, seed: int) -> Plan:
        """Return the plan with other numbers; None leaves one as it is."""
        training = replace(self.training, steps=self.training.steps if steps is None else steps, seed=seed)
        return replace(self, worlds=self.worlds if worlds is None else worlds, first=first, training=training)


USUAL = Plan()
"""What the weights in the package were made by."""

SMOKE = Plan(
    worlds=3,
    validation=1,
    most=16,
    recipe=Recipe(
        built=0.0,
        size=(120.0, 120.0),
        submaps=16,
        sensors=("os64",),
        stems=(150.0, 400.0),
        pulses=(5.0, 10.0),
        slope=(0.0, 10.0),
        travel=(3.0, 8.0),
        rays=60_000,
    ),
    training=TrainingConfig(steps=100, pieces=2, each=6, rate=1e-2, width=8, wrong=2),
)
"""A minute on two cores: whether everything works and something is learnt, not how well it can be."""


def train_session(
    out: Path, plan: Plan, workers: int = 2, threads: int = 0, say: Say = lambda line: None
) -> dict[str, Any]:
    """Train into the directory ``out`` and return the card that is written there with the weights.

    Worlds that are in ``out / worlds`` already are not simulated again, and a training that was interrupted goes on.

    Raises:
        ConfigError: a number is out of range. InputError: something cannot be written, or what is there is of
            another recipe or another training.
        DependencyError: PyTorch, ONNX or Open3D is not installed.
    """
    torch = require_library("torch", "torch==2.13.0", "training (extra learn-train)")
    require_library("onnx", "onnx>=1.16", "training (extra learn-train)")
    from coview_stream.training.networks import encoder, export
    from coview_stream.training.training import train

    if threads > 0:
        torch.set_num_threads(threads)
    paths = write_dataset(
        out / "worlds",
        [*plan.seeds, *plan.held_out],
        plan.recipe,
        workers,
        lambda seed, s: say(f"world {seed}: {s:.0f} s"),
    )
    worlds = [read_world(path) for path in paths]
    for path, world in zip(paths, worlds, strict=True):
        if world.recipe["recipe"] != json.loads(json.dumps(plan.recipe.to_dict())):
            raise InputError(f"{path}: a world of another recipe; choose another folder, or delete it")
    history: list[list[float]] = []

    def report(step: int, found: Any) -> None:
        history.append([float(x.detach()) for x in (found.dense, found.local, found.place)] + [found.recall])
        if (step + 1) % _EVERY == 0:
            dense, local, place, recall = np.mean(history[-_EVERY:], axis=0)
            say(
                f"step {step + 1}: dense {dense:.3f}, local {local:.3f}, place {place:.3f}, recall {recall:.2f}"
            )

    net = train(worlds[: plan.worlds], plan.training, report, out / "checkpoint.pt")
    say("judging")
    judged = judge(worlds[plan.worlds :], encoder(net, "aerial"), encoder(net, "ground"), plan.most)
    card = {
        "version": __version__,
        "torch": str(torch.__version__),
        "plan": asdict(plan),
        "data_sha256": _digest(paths[: plan.worlds]),
        "threads": int(torch.get_num_threads()),
        "parameters": sum(p.numel() for p in net.parameters()),
        "loss": {"first": history[0][0], "last": float(np.mean([row[0] for row in history[-_EVERY:]]))}
        if history
        else {},
        "validation": judged,
    }
    export(net, out, card)
    return card


def judge(worlds: Sequence[WorldViews], aerial: Any, ground: Any, most: int) -> dict[str, Any]:
    """Share of queries that the dense search puts right, over all and by sensor, and what chance would give."""
    from coview_stream.training.recall import seek

    sought = seek(worlds, aerial, ground, most)
    area = float(np.mean([world.aerial[0].size * 0.25 for world in worlds]))
    result: dict[str, Any] = {
        "worlds": len(worlds),
        "queries": len(sought),
        "AR@1": float(np.mean([each.right(1) for each in sought])),
        "AR@5": float(np.mean([each.right(5) for each in sought])),
        "chance": float(np.pi * 10.0**2 / area),
    }
    for sensor in sorted({each.sensor for each in sought}):
        result[sensor] = float(np.mean([each.right(1) for each in sought if each.sensor == sensor]))
    return result


def _digest(paths: Sequence[Path]) -> str:
    """Return the hash of what the worlds hold: the files themselves differ with the compression's version."""
    total = hashlib.sha256()
    for path in paths:
        world = read_world(path)
        for array in (world.aerial, world.queries, world.poses):
            total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()
