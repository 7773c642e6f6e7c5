"""Training from end to end: simulated worlds, the training loop, weights, and a card with their recall."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.config.checks import counts
from coview_stream.descriptors.birds_eye_view import Image
from coview_stream.descriptors.network import Features
from coview_stream.errors import ConfigError, InputError, require_library
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.localization.search.learned.correlation import FeatureIndex, correlate, downsample, rotate_images
from coview_stream.training.recipe import Recipe, TrainingConfig
from coview_stream.training.sensors import TRAINED_DIRT
from coview_stream.training.worlds import WorldViews, read_world, write_dataset
from coview_stream.version import __version__

_REPORT_STEPS = 20  # between lines of progress
_HELD_OUT = 19_000  # first seed of the worlds that training never uses

Say = Callable[[str], None]
"""Takes a line of progress."""


@dataclass(frozen=True)
class Plan:
    """Plan of a training: its worlds and its settings; the card next to the weights holds it."""

    worlds: int = 62  # number of training worlds, whose seeds are consecutive
    first: int = 10_000  # first seed
    validation: int = 8  # number of worlds with other seeds for the evaluation
    most: int = 60  # most queries evaluated in each of these
    recipe: Recipe = field(default_factory=Recipe)  # ranges that worlds are drawn from
    training: TrainingConfig = field(default_factory=TrainingConfig)  # settings of the training loop

    def __post_init__(self) -> None:
        counts(self, "worlds", "validation", "most")
        if self.first < 0 or self.seeds[-1] >= _HELD_OUT:
            raise ConfigError(
                f"worlds {self.first} to {self.seeds[-1]}: seeds from 0 to {_HELD_OUT - 1} may be trained on, those "
                "beyond are held out"
            )

    @property
    def seeds(self) -> range:
        """Seeds of the training worlds."""
        return range(self.first, self.first + self.worlds)

    @property
    def held_out(self) -> range:
        """Seeds of the evaluation worlds."""
        return range(_HELD_OUT, _HELD_OUT + self.validation)

    def with_dirt(self) -> Plan:
        """Return the plan with all kinds of dirt in its drives, and the seasons mixed evenly."""
        return replace(self, recipe=replace(self.recipe, dirt=TRAINED_DIRT, leaf_off=0.5))

    def with_numbers(self, worlds: int | None, steps: int | None, first: int, seed: int) -> Plan:
        """Return the plan with other numbers; None keeps the plan's own."""
        training = replace(self.training, steps=self.training.steps if steps is None else steps, seed=seed)
        return replace(self, worlds=self.worlds if worlds is None else worlds, first=first, training=training)


DEFAULT = Plan()
"""Plan of the weights in the package."""

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
"""Plan for a minute on two cores: shows that training works and learns, not how good it can get."""


def train_session(
    out: Path, plan: Plan, workers: int = 2, threads: int = 0, say: Say = lambda line: None
) -> dict[str, Any]:
    """Train into the directory ``out``, and return the card that is written there with the weights.

    Worlds that are already in ``out / worlds`` are reused, and an interrupted training resumes.

    Raises:
        ConfigError: a number is out of range. InputError: a file cannot be written, or the directory holds worlds of
            another recipe or the state of another training.
        DependencyError: PyTorch is not installed.
    """
    torch = require_library("torch", "torch==2.13.0", "training (extra learn-train)")
    from coview_stream.training.loop import train
    from coview_stream.training.networks import encoder, export

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
        if world.recipe["recipe"] != json.loads(json.dumps(asdict(plan.recipe))):
            raise InputError(f"{path}: a world of another recipe; choose another folder, or delete it")
    history: dict[int, list[float]] = {}  # by step; a resumed training has none of those before

    def report(step: int, loss: Any) -> None:
        history[step] = [float(x.detach()) for x in (loss.dense, loss.local, loss.place)] + [loss.recall]
        if (step + 1) % _REPORT_STEPS == 0:
            dense, local, place, found_share = np.mean([*history.values()][-_REPORT_STEPS:], axis=0)
            say(f"step {step + 1}: dense {dense:.3f}, local {local:.3f}, place {place:.3f}, recall {found_share:.2f}")

    net = train(worlds[: plan.worlds], plan.training, report, out / "checkpoint.pt")
    say("evaluating")
    recall = evaluate(worlds[plan.worlds :], encoder(net, "aerial"), encoder(net, "ground"), plan.most)
    card: dict[str, Any] = {
        "version": __version__,
        "torch": str(torch.__version__),
        "plan": asdict(plan),
        "data_sha256": _digest(worlds[: plan.worlds]),
        "threads": int(torch.get_num_threads()),
        "parameters": sum(p.numel() for p in net.parameters()),
        "loss": {"first": history[0][0]} if 0 in history else {},
        "validation": recall,
    }
    if history:
        card["loss"]["last"] = float(np.mean([row[0] for row in [*history.values()][-_REPORT_STEPS:]]))
    export(net, out, card)
    return card


def evaluate(worlds: Sequence[WorldViews], aerial: Any, ground: Any, max_queries: int) -> dict[str, Any]:
    """Return the shares of queries found first (AR@1, also by sensor) and among five (AR@5), and that by chance."""
    results = search_queries(worlds, aerial, ground, max_queries)
    area = float(np.mean([world.aerial[0].size * 0.25 for world in worlds]))
    result: dict[str, Any] = {
        "worlds": len(worlds),
        "queries": len(results),
        "AR@1": float(np.mean([query.found_among(1) for query in results])),
        "AR@5": float(np.mean([query.found_among(5) for query in results])),
        "chance": float(np.pi * 10.0**2 / area),
    }
    for sensor in sorted({query.sensor for query in results}):
        result[sensor] = float(np.mean([query.found_among(1) for query in results if query.sensor == sensor]))
    return result


def _digest(worlds: Sequence[WorldViews]) -> str:
    """Return the hash of the worlds' arrays, as their files depend on the version of the compression."""
    total = hashlib.sha256()
    for world in worlds:
        for array in (world.aerial, world.queries, world.poses):
            total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


HEADINGS = 36
"""Headings that the dense search tries."""

_CELL = 2.0  # metres of the dense search
_BEST = 5  # places kept
_DISTINCT = 10.0  # least metres between two places
_MAX_ERROR = 10.0  # metres from the truth within which a place counts as found
_RADIUS = 29.0  # metres around a query's centre within which cells are compared, as in the losses

Encoder = Callable[[Image], Features]


@dataclass(frozen=True)
class SearchedQuery:
    """One query and the places that the search found."""

    world: int  # index of its world
    sensor: str  # of the robot
    travelled: float  # metres driven for it
    places: Floats  # (5, 3) x, y (metres) and heading (radians) of the best places, best first
    pose: Floats  # (3,) the true x, y and heading
    scores: Floats  # (5,) of the places

    def found_among(self, best: int = 1) -> bool:
        """Return whether one of the ``best`` places lies within 10 m of the truth."""
        apart = np.linalg.norm(self.places[:best, :2] - self.pose[:2], axis=1)
        return bool((apart < _MAX_ERROR).any())


def search_queries(
    worlds: Sequence[WorldViews], aerial: Encoder, ground: Encoder, max_queries: int | None = None
) -> list[SearchedQuery]:
    """Search every query (at most ``max_queries`` per world) in its world's map, at all places and 36 headings."""
    yaws = np.arange(HEADINGS) * 2 * np.pi / HEADINGS
    results = []
    for number, world in enumerate(worlds):
        rows, columns = (n // 8 * 8 for n in world.aerial.shape[1:])  # whole cells of 4 m
        features, _ = downsample(aerial(world.aerial[:, :rows, :columns]).local)
        index = FeatureIndex(features, world.corner, _CELL)
        for k in range(len(world.queries))[:max_queries]:
            query = ground(world.queries[k])
            local, weight = downsample(query.local, weights(query.sigma))
            turned = rotate_images(np.concatenate([local, weight[None]]), yaws[: HEADINGS // 2])
            volume = correlate(turned, index, opposite=True)
            places, scores = best_places(volume, yaws, world.corner)
            results.append(
                SearchedQuery(number, str(world.sensor[k]), float(world.travelled[k]), places, world.poses[k], scores)
            )
    return results


def weights(sigma: Floats32) -> Floats32:
    """Return weights (h, h) of a query's cells, 1 / sigma within 29 m of the centre, from sigma (h, h)."""
    at = np.arange(len(sigma)) + 0.5 - len(sigma) / 2
    return np.asarray((np.hypot(at[:, None], at[None]) < _RADIUS) / sigma, dtype=np.float32)


def best_places(volume: Floats32, yaws: Floats, corner: Floats) -> tuple[Floats, Floats]:
    """Find the highest peaks of (K, H, W), 10 m or more apart: places (5, 3) and scores (5,)."""
    top = volume.max(axis=0)
    places, scores = [], []
    rows, columns = np.indices(top.shape)
    for _ in range(_BEST):
        row, column = np.unravel_index(int(top.argmax()), top.shape)
        yaw = yaws[int(volume[:, row, column].argmax())]
        places.append([*(corner + (np.array([column, row]) + 0.5) * _CELL), yaw])
        scores.append(float(top[row, column]))
        top = np.where(np.hypot(rows - row, columns - column) * _CELL < _DISTINCT, -np.inf, top)
    return np.array(places), np.array(scores)
