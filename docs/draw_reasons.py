"""Draw why a robot is not found: one picture of `coview-stream locate` for each kind of reason.

    python docs/draw_reasons.py docs/images

A small town is simulated; it is then mapped twice side by side, mapped without the robot's surroundings, driven with a
lidar that sees little, and searched for a robot of another town.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from coview_stream.cli import main as coview_stream
from coview_stream.clouds.files import read_cloud, write_cloud
from coview_stream.clouds.trajectory import read_tum

SIZE, COLOURS = 620, 48  # pixels of an edge, and colours: below 100 kB


def run(*words: object) -> int:
    """Run a command."""
    return coview_stream([str(word) for word in words])


def draw(name: str, site: Path, recorded: Path, out: Path) -> None:
    """Locate a run, and shrink the picture."""
    results = site.parent / f"out-{name}"
    run("locate", site, recorded, "-o", results)
    picture = Image.open(results / "trajectory.png").convert("RGB")
    picture.thumbnail((SIZE, SIZE))
    picture.quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
        out / f"reason_{name}.png", optimize=True
    )
    print(f"{name}: {json.loads((results / 'result.json').read_text())['reason']}")


def near(recorded: Path, out: Path, metres: float) -> Path:
    """Write a run whose lidar sees only so many metres."""
    (out / "frames").mkdir(parents=True)
    for file in sorted((recorded / "frames").iterdir()):
        points = read_cloud(file).points
        write_cloud(out / "frames" / file.name, points[np.hypot(points[:, 0], points[:, 1]) < metres])
    (out / "odometry.tum").write_text((recorded / "odometry.tum").read_text())
    return out


def main(out: Path, folder: Path) -> None:
    """Make the worlds in a folder, and the pictures."""
    for seed in (3, 4):
        words = ("--scene", "town", "--sensor", "vlp16", "--seed", seed, "--size", 160, "--length", 12)
        run("simulate", folder / f"town{seed}", *words)
    town = folder / "town3"
    points = read_cloud(town / "base.laz").points
    start = read_tum(town / "truth.tum")[1][0, :2, 3]
    clouds = {
        "town": points,
        "twin": np.concatenate([points, points + np.array([200.0, 0.0, 0.0], dtype=points.dtype)]),
        "hole": points[np.abs(points[:, :2] - start).max(axis=1) > 45.0],
    }
    for name, cloud in clouds.items():
        write_cloud(folder / f"{name}.laz", cloud)
        run("build", folder / f"{name}.laz", "-o", folder / f"{name}.coview", "--no-learned")
    draw("twin", folder / "twin.coview", town / "run", out)
    draw("elsewhere", folder / "town.coview", folder / "town4" / "run", out)
    draw("hole", folder / "hole.coview", town / "run", out)
    draw("little", folder / "town.coview", near(town / "run", folder / "near", 7.0), out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Pictures of robots that are not found.")
    parser.add_argument("out", type=Path, help="folder of the pictures")
    with tempfile.TemporaryDirectory() as folder:
        main(parser.parse_args().out, Path(folder))
