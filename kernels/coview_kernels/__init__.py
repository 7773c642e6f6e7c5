"""Numerical kernels of coview_stream: functions from arrays to arrays, without files, network or localization.

Every function checks its arguments, then runs in Taichi, one call at a time, or in NumPy
(:mod:`coview_kernels.reference`) if Taichi is missing or ``COVIEW_KERNELS=numpy`` is set; both agree. A few always run
in NumPy. Any thread may call them. Importing this package does not import Taichi; the first call does.
"""

from __future__ import annotations

from coview_kernels.arrays import OverheadGrid, PolarGrid, Raster
from coview_kernels.covisibility import coview, paper_context
from coview_kernels.crop import Crop, Cut, crop_points
from coview_kernels.distinct import distinct_poses
from coview_kernels.field import (
    FieldMap,
    FieldScan,
    FieldScores,
    Move,
    field_scores,
    ground_heights,
    near_structure,
    unexplained,
)
from coview_kernels.icp import SCATTER, Prior, Registration, Scale, align_planes
from coview_kernels.nearest import PointGrid, nearest
from coview_kernels.overhead import height_columns, lowest_heights, offsets_near
from coview_kernels.polar import polar_bin, station_bins
from coview_kernels.rays import TriangleTree, cast_rays, triangle_tree
from coview_kernels.runtime import backend, shutdown, submit
from coview_kernels.similarity import all_shift_distance, column_spectra, unit_columns
from coview_kernels.station_codes import CodedQuery, StationCodes
from coview_kernels.voxel_filter import transform_unique
from coview_kernels.warm_up import warm_up
from coview_kernels.windows import WindowImages, WindowRaster, window_products

__all__ = [
    "SCATTER",
    "CodedQuery",
    "Crop",
    "Cut",
    "FieldMap",
    "FieldScan",
    "FieldScores",
    "Move",
    "OverheadGrid",
    "PointGrid",
    "PolarGrid",
    "Prior",
    "Raster",
    "Registration",
    "Scale",
    "StationCodes",
    "TriangleTree",
    "WindowImages",
    "WindowRaster",
    "align_planes",
    "all_shift_distance",
    "backend",
    "cast_rays",
    "column_spectra",
    "coview",
    "crop_points",
    "distinct_poses",
    "field_scores",
    "ground_heights",
    "height_columns",
    "lowest_heights",
    "near_structure",
    "nearest",
    "offsets_near",
    "paper_context",
    "polar_bin",
    "shutdown",
    "station_bins",
    "submit",
    "transform_unique",
    "triangle_tree",
    "unexplained",
    "unit_columns",
    "warm_up",
    "window_products",
]
