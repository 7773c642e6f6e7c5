"""Animate a first fix: the lidar's scan, the places that the search considers, and the trail.

    python docs/animate_first_fix.py docs/images/first_fix.gif

The town and the drive are those of `coview-stream demo`, but the lidar sees 14 m only. With its full range the robot is
found at the first keyframe, and there is nothing to watch.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from coview_stream import BaseMap, Fix, Localizer, LocalizerConfig
from coview_stream.cli import main as coview_stream
from coview_stream.clouds.trajectory import read_tum
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.search.acceptance import Considered
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.recordings import open_run
from coview_stream.report.plots import STATE_COLOURS, draw_base_map

EVERY, EVERY_AFTER = 3, 5  # frames of the run per picture, before and after the first fix
AFTER = 200  # frames of the run after the first fix
AROUND = 24.0  # metres to each side of the robot in the right half
PAUSE = 6  # periods that the picture of the first fix stays
SIZE, DPI, PERIOD_MS = (9.0, 5.1), 84, 150


class Step(NamedTuple):
    """One frame: true pose, fix, reason, scan (N, 3) in the body frame, hypotheses."""

    truth: np.ndarray
    fix: Fix
    reason: str
    points: np.ndarray
    considered: Considered | None


def steps(base_map: BaseMap, world: Path, reach: float) -> Iterator[Step]:
    """Localize a run whose lidar sees ``reach`` metres."""
    _, truth = read_tum(world / "truth.tum")
    config = LocalizerConfig()
    localizer = Localizer(base_map, config)
    search = GlobalSearch(base_map, config, LocalMaps(base_map, config.registration.source_range))
    considered, remaining = None, AFTER
    for frame, T_map_body in zip(open_run(world / "run"), truth, strict=True):
        points = frame.points[np.hypot(frame.points[:, 0], frame.points[:, 1]) < reach]
        request = localizer.add_frame(points, frame.T_odom_body, frame.stamp)
        if request is not None:
            result = search.update(request)
            localizer.apply_search_result(result)
            considered = result.considered
        fix = localizer.fix()
        remaining -= fix.T_map_body is not None
        yield Step(T_map_body, fix, "" if fix.evidence is None else fix.evidence.reason, points, considered)
        if not remaining:
            return


class Picture:
    """The figure: the map with hypotheses and trail on the left, the newest scan on the right."""

    def __init__(self, base_map: BaseMap) -> None:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt

        self.figure, (self.map, self.near) = plt.subplots(1, 2, figsize=SIZE, dpi=DPI)
        self.figure.subplots_adjust(0.01, 0.02, 0.99, 0.85, wspace=0.02)
        points = base_map.sampled_points(1_000_000) + base_map.origin
        for axes in (self.map, self.near):
            draw_base_map(axes, points)
            axes.set(xticks=[], yticks=[], xlabel="", ylabel="", adjustable="box")
            axes.images[0].set_alpha(0.6)
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        self.map.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        self.ground = self.near.images[0]
        self.trail: list[np.ndarray] = []

    def draw(self, step: Step) -> Any:
        """Draw a step and return it as a Pillow image."""
        from PIL import Image

        drawn = self._draw(step)
        self.figure.canvas.draw()
        pixels = np.asarray(self.figure.canvas.buffer_rgba())[..., :3].copy()
        for artist in drawn:
            artist.remove()
        return Image.fromarray(pixels)

    def _draw(self, step: Step) -> list[Any]:
        state = step.fix.state.reported
        colour = STATE_COLOURS[state]
        head = {"transform": self.figure.transFigure, "fontsize": 15, "fontweight": "bold", "color": colour}
        drawn = [self.figure.text(0.012, 0.93, state, **head), self.figure.text(0.185, 0.931, step.reason, fontsize=13)]
        T = step.fix.T_map_body
        title = "places that the search considers" if T is None else "the robot and its trail"
        drawn.append(self.figure.text(0.012, 0.87, f"{title} (ring: the truth)", fontsize=11))
        self.ground.set_visible(T is not None)
        title = "newest scan, on the map" if T is not None else "newest scan"
        drawn.append(self.figure.text(0.508, 0.87, title, fontsize=11))
        points = step.points[step.points[:, 2] > -1.2][::3].astype(np.float64)  # without the ground
        centre = np.zeros(2)
        ring = {"s": 260, "facecolors": "none", "edgecolors": "black", "linewidths": 1.6, "zorder": 6}
        drawn.append(self.map.scatter(*step.truth[:2, 3], **ring))
        if T is None:
            drawn += self._draw_hypotheses(step.considered, colour)
        else:
            points = points @ T[:3, :3].T + T[:3, 3]
            centre = T[:2, 3]
            self.trail.append(T[:2, 3])
            drawn += self._draw_robot(T, colour)
        drawn.append(self.near.scatter(points[:, 0], points[:, 1], s=4, color="#009E73", linewidths=0))
        if T is None:
            drawn.append(self.near.scatter(0.0, 0.0, s=330, marker=(3, 0, -90), color=colour, zorder=5))
        self.near.set(xlim=centre[0] + np.array([-AROUND, AROUND]), ylim=centre[1] + np.array([-AROUND, AROUND]))
        return drawn

    def _draw_hypotheses(self, considered: Considered | None, colour: str) -> list[Any]:
        if considered is None:
            return []
        x, y, _, yaw, probability, _ = considered.places.T
        size = 40.0 + 600.0 * probability
        marks = self.map.scatter(x, y, s=size, color=colour, edgecolors="white", linewidths=1.0, zorder=4)
        ahead = self.map.quiver(x, y, np.cos(yaw), np.sin(yaw), color=colour, scale=24, width=0.006, zorder=4)
        words = f"probability of none of them: {considered.none:.0%}"
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 3.0}
        return [
            marks,
            ahead,
            self.map.text(0.02, 0.025, words, transform=self.map.transAxes, fontsize=11, bbox=box, zorder=9),
        ]

    def _draw_robot(self, T: np.ndarray, colour: str) -> list[Any]:
        way = np.array(self.trail)
        heading = np.degrees(np.arctan2(T[1, 0], T[0, 0]))
        drawn: list[Any] = []
        for axes, size in ((self.map, 110), (self.near, 330)):
            drawn += axes.plot(way[:, 0], way[:, 1], color=colour, linewidth=2.5, zorder=3)
            mark = {"marker": (3, 0, heading - 90.0), "color": colour, "edgecolors": "white", "zorder": 5}
            drawn.append(axes.scatter(T[0, 3], T[1, 3], s=size, **mark))
        return drawn


def animate(place: Path, world: Path, reach: float) -> None:
    """Simulate, build, localize and draw ``place``; the other files go to ``world``."""
    from PIL import Image

    coview_stream(["simulate", str(world), "--scene", "town", "--sensor", "os64", "--seed", "3"])
    coview_stream(["build", str(world / "base.laz"), "-o", str(world / "site.coview"), "--no-learned"])
    base_map = BaseMap.load(world / "site.coview")
    figure, pictures, periods, located = Picture(base_map), [], [], False
    for number, step in enumerate(steps(base_map, world, reach)):
        first = step.fix.T_map_body is not None and not located
        located = located or first
        if first or number % (EVERY_AFTER if located else EVERY) == 0:
            pictures.append(figure.draw(step))
            periods.append(PERIOD_MS * (PAUSE if first else 1))
    periods[-1] = PERIOD_MS * 2 * PAUSE
    # one palette: colours do not flicker, and unchanged pixels are not stored again
    sheet = Image.new("RGB", (pictures[0].width, 3 * pictures[0].height + 80))
    for row, sample in enumerate((pictures[0], pictures[len(pictures) // 2], pictures[-1])):
        sheet.paste(sample, (0, row * sample.height))
    for number, colour in enumerate(STATE_COLOURS.values()):  # too few pixels to get a colour otherwise
        sheet.paste(colour, (100 * number, sheet.height - 80, 100 * number + 100, sheet.height))
    palette = sheet.quantize(96, kmeans=2)
    flat = [picture.quantize(palette=palette, dither=0) for picture in pictures]
    flat[0].save(place, save_all=True, append_images=flat[1:], duration=periods, loop=0, optimize=True)
    print(f"{place}: {len(flat)} frames, {place.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Animated picture of a first fix.")
    parser.add_argument("place", type=Path, help="GIF to write")
    parser.add_argument("--range", type=float, default=14.0, dest="reach", help="metres that the lidar sees (14)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        animate(args.place, Path(folder) / "world", args.reach)
