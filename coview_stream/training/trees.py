"""Random forests: the ground, and the places, species and sizes of the trees."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from coview_stream.geometry.arrays import Bools, Floats, Ints
from coview_stream.sim.mesh import Mesh, height_field
from coview_stream.training.recipe import Recipe

Field = Callable[[Floats, Floats], Floats]

_STEP = 1.0  # metres between grid points


def waves(rng: np.random.Generator, wavelength: float, count: int = 8) -> Field:
    """Draw a smooth function of x and y (N,) with mean 0, variance 1 and about the given wavelength, metres."""
    heading, phase = rng.uniform(0, 2 * np.pi, (2, count))
    number = 2 * np.pi / (wavelength * rng.uniform(0.7, 1.4, count))
    kx, ky = number * np.cos(heading), number * np.sin(heading)

    def field(x: Floats, y: Floats) -> Floats:
        total = np.zeros(np.shape(x))
        for a, b, p in zip(kx, ky, phase, strict=True):
            total += np.cos(a * x + b * y + p)
        return np.asarray(total * np.sqrt(2.0 / count))

    return field


class Terrain:
    """A square of ground, +-``half`` metres about the origin.

    Without ``roughness`` (metres), ``slope`` (degrees) is exceeded on 5 % of the area.
    """

    def __init__(self, rng: np.random.Generator, half: float, slope: float, roughness: float) -> None:
        self.half = half
        self._axis: Floats = np.linspace(-half, half, 2 * int(half / _STEP) + 1, dtype=np.float64)
        X, Y = np.meshgrid(self._axis, self._axis, indexing="ij")
        heading, share = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.7)
        tilted = share * (X * np.cos(heading) + Y * np.sin(heading))
        z = np.zeros_like(X)
        shortness = rng.uniform(0.7, 1.6)  # exponent of the wavelength in the amplitude
        for wavelength in (220.0, 110.0, 55.0, 27.0):
            z += wavelength**shortness * rng.uniform(0.2, 1.0) * waves(rng, wavelength, 5)(X, Y)
        z = tilted + (1 - share) * z / _steepness(z)
        z *= np.tan(np.radians(slope)) / max(_steepness(z), 1e-6)
        bumps = gaussian_filter(rng.normal(size=X.shape), rng.uniform(1.0, 3.0))
        self._heights: Floats = z - z.mean() + roughness * bumps / bumps.std()

    def z(self, x: Floats, y: Floats) -> Floats:
        """Return the ground height (N,) at coordinates (N,), metres."""
        scale = (len(self._axis) - 1) / (2 * self.half)
        at = (np.stack([np.asarray(x), np.asarray(y)]) + self.half) * scale
        return np.asarray(map_coordinates(self._heights, at, order=1, mode="nearest"))

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest ground, metres."""
        return float(self._heights.min()), float(self._heights.max())

    def mesh(self) -> Mesh:
        """Return a mesh of the ground."""
        return height_field(self._axis, self._heights)


def _steepness(z: Floats) -> float:
    """Return the slope that is exceeded on 5 % of a grid."""
    return float(np.quantile(np.hypot(*np.gradient(z, _STEP)), 0.95))


FAMILIES = ("lumpy", "cone", "storeys", "umbrella", "clumps", "column")

PATTERNS = ("random", "clustered", "hard-core", "rows")

_EVERGREEN = {"cone": 0.9, "storeys": 0.95, "umbrella": 0.5, "column": 0.6}  # chance, else never
_MIN_SPACING = 0.8  # metres between two stems


class Species(NamedTuple):
    """Tree species: crown family; crown diameter, lowest leaves and stem radius as shares of the height."""

    family: str
    width: float
    base: float
    thick: float
    evergreen: bool


class Trees(NamedTuple):
    """Columns (N,) of all trees, metres."""

    x: Floats  # of the foot
    y: Floats  # of the foot
    z: Floats  # of the foot
    height: Floats  # of the top above the foot
    radius: Floats  # of the stem
    crown: Floats  # radius of the crown
    base: Floats  # height of the lowest leaves above the foot
    lean: Floats  # (N, 2) metres per metre of height
    offset: Floats  # (N, 2) of the crown's centre from the stem's axis
    family: Ints  # index into FAMILIES
    evergreen: Bools  # whether it keeps its leaves in winter
    dead: Bools  # whether it is bare

    def axis(self, up: Floats, of: Ints | slice = slice(None)) -> Floats:
        """Return points (M, 3) of the stems' axes ``up`` (M,) metres above their feet, bent towards their crowns."""
        bent = self.offset[of] * (0.7 * np.clip(up / self.height[of], 0, 1) ** 1.5)[:, None]
        xy = np.column_stack([self.x[of], self.y[of]]) + self.lean[of] * up[:, None] + bent
        return np.column_stack([xy, self.z[of] + up])

    def crown_axis(self, up: Floats, of: Ints | slice = slice(None)) -> Floats:
        """Return points (M, 3) on the axes of the crowns, ``up`` (M,) metres above their feet."""
        xy = np.column_stack([self.x[of], self.y[of]]) + self.lean[of] * up[:, None] + self.offset[of]
        return np.column_stack([xy, self.z[of] + up])


def draw_species(rng: np.random.Generator, recipe: Recipe) -> list[Species]:
    """Draw the one to four species of a stand."""
    species = []
    for _ in range(int(rng.choice([1, 2, 3, 4], p=[0.35, 0.3, 0.2, 0.15]))):
        family = str(rng.choice(FAMILIES))
        evergreen = bool(rng.random() < _EVERGREEN.get(family, 0.0))
        width, base = recipe.draw(rng, "crown_width"), recipe.draw(rng, "crown_base")
        species.append(Species(family, width, base, rng.uniform(0.006, 0.016), evergreen))
    return species


def draw_trees(rng: np.random.Generator, recipe: Recipe, terrain: Terrain, xy: Floats, species: list[Species]) -> Trees:
    """Draw the sizes of trees at places (N, 2)."""
    count = len(xy)
    # species grow in patches, or mixed
    scores = [
        waves(rng, rng.uniform(30, 100))(*xy.T) * rng.uniform(0, 2) + rng.gumbel(size=count) + rng.normal()
        for _ in species
    ]
    kind = np.argmax(np.array(scores), axis=0)
    height = _heights(rng, recipe, xy)
    pick = {name: np.array([getattr(sort, name) for sort in species])[kind] for name in Species._fields}
    crown = _crowns(rng, recipe, pick["width"], height, (2 * terrain.half) ** 2)
    base = np.clip(pick["base"] + rng.normal(0, 0.06, count), *recipe.crown_base) * height
    radius = np.clip(pick["thick"] * height * rng.lognormal(0, 0.25, count), *recipe.stem_radius)
    far = recipe.draw(rng, "crown_offset") * np.sqrt(rng.random(count)) * np.minimum(1, crown / 1.5)
    angle = rng.uniform(0, 2 * np.pi, count)
    return Trees(
        x=xy[:, 0],
        y=xy[:, 1],
        z=terrain.z(*xy.T),
        height=height,
        radius=radius,
        crown=crown,
        base=base,
        lean=rng.normal(0, rng.uniform(0.0, 0.05), (count, 2)),
        offset=far[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]),
        family=np.array([FAMILIES.index(str(name)) for name in pick["family"]], dtype=np.int64),
        evergreen=pick["evergreen"].astype(bool),
        dead=rng.random(count) < recipe.draw(rng, "dead"),
    )


def _crowns(rng: np.random.Generator, recipe: Recipe, share: Floats, height: Floats, area: float) -> Floats:
    """Draw crown radii (N,), metres, from their usual ``share`` of the height; half of the stands are closed."""
    low, high = (width * height / 2 for width in recipe.crown_width)
    wide = share * rng.lognormal(0, 0.15, len(height)) * height / 2
    if rng.random() < 0.5:
        wide = wide * np.sqrt(rng.uniform(0.7, 2.0) * area / max(float((np.pi * wide**2).sum()), 1.0))
    # dense trees have narrow crowns
    room = max(0.6, rng.uniform(0.8, 1.8) * float(np.sqrt(area / max(len(height), 1))) / 2)
    return np.minimum(np.clip(wide, low, high), room * rng.uniform(0.85, 1.15, len(height)))


def _heights(rng: np.random.Generator, recipe: Recipe, xy: Floats) -> Floats:
    low, high = recipe.tree_height
    mean = rng.uniform(low + 0.05 * (high - low), low + 0.9 * (high - low))
    height = mean * (1 + rng.uniform(0, 0.2) * waves(rng, rng.uniform(40, 150))(*xy.T))
    if rng.random() < 0.4:  # uneven-aged
        height = height * (1 - rng.uniform(0.3, 0.8) * rng.beta(1.0, rng.uniform(1.0, 2.5), len(xy)))
    return np.clip(height * (1 + rng.normal(0, rng.uniform(0.03, 0.12), len(xy))), low, high)


def draw_stems(rng: np.random.Generator, pattern: str, per_hectare: float, half: float) -> Floats:
    """Draw positions (N, 2) of stems within +-``half`` metres, in one of ``PATTERNS``."""
    area = (2 * half) ** 2
    count = int(per_hectare * area / 1e4)
    spacing = np.sqrt(1e4 / per_hectare)
    if pattern == "rows":
        stretch = rng.uniform(1.0, 1.6)
        across, along = spacing * np.sqrt(stretch), spacing / np.sqrt(stretch)
        u, v = np.arange(-1.5 * half, 1.5 * half, across), np.arange(-1.5 * half, 1.5 * half, along)
        xy = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        xy = xy + rng.normal(0, rng.uniform(0.05, 0.2) * along, xy.shape)
        yaw = rng.uniform(0, np.pi)
        xy = xy @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        return np.asarray(xy[(np.abs(xy) < half).all(axis=1) & (rng.random(len(xy)) > rng.uniform(0, 0.25))])
    if pattern == "clustered":
        per = rng.uniform(3, 15)
        parents = rng.uniform(-half, half, (max(1, int(count / per)), 2))
        xy = parents[rng.integers(0, len(parents), count)] + rng.normal(0, rng.uniform(1.5, 5.0), (count, 2))
        return xy[_spaced(rng, xy, _MIN_SPACING) & (np.abs(xy) < half).all(axis=1)]
    dense = rng.uniform(-half, half, (int(1.6 * count) if pattern == "hard-core" else count, 2))
    apart = rng.uniform(0.45, 0.7) * spacing if pattern == "hard-core" else _MIN_SPACING
    return dense[_spaced(rng, dense, apart)][:count]


def _spaced(rng: np.random.Generator, xy: Floats, apart: float) -> Bools:
    """Return a mask (N,) without the lower-ranked stem of each pair nearer than ``apart``; ranks are random."""
    keep = np.ones(len(xy), dtype=bool)
    pairs = cKDTree(xy).query_pairs(apart, output_type="ndarray")
    rank = rng.random(len(xy))
    keep[np.where(rank[pairs[:, 0]] < rank[pairs[:, 1]], pairs[:, 0], pairs[:, 1])] = False
    return keep


def opened(rng: np.random.Generator, xy: Floats, half: float) -> Bools:
    """Mask (N,) the stems that remain after thin parts, gaps and perhaps a trail."""
    keep = np.ones(len(xy), dtype=bool)
    if rng.random() < 0.6:
        uneven = waves(rng, rng.uniform(40, 120))(xy[:, 0], xy[:, 1])
        keep &= rng.random(len(xy)) < 1 / (1 + np.exp(-2.0 - rng.uniform(0, 1.5) * uneven))
    for _ in range(rng.poisson(rng.choice([0.0, 2.0, 6.0]))):
        middle, radii = rng.uniform(-half, half, 2), rng.uniform(4, 16, 2)
        keep &= ((xy - middle) ** 2 / radii**2).sum(axis=1) > 1
    if rng.random() < 0.7:
        along = np.arange(-1.5 * half, 1.5 * half, 1.0)
        bend = rng.uniform(-0.4, 0.4) * half
        sideways = bend + rng.uniform(0, 12) * waves(rng, rng.uniform(60, 140))(along, np.zeros_like(along))
        yaw = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(yaw), np.sin(yaw)
        trail = np.column_stack([along, sideways]) @ np.array([[c, s], [-s, c]])
        keep &= cKDTree(trail).query(xy)[0] > rng.uniform(1.0, 2.5)
    return keep
