"""NumPy twins of the kernels.

They are the oracle of the tests, and the implementation if Taichi has no wheel or ``COVIEW_KERNELS=numpy`` is set.
The public functions of :mod:`coview_kernels` check the arguments, and pass them in the form that the kernel takes.
"""

from __future__ import annotations

from coview_kernels.reference.covisibility import coview, dense, paper_context, visible
from coview_kernels.reference.crop import crop_points
from coview_kernels.reference.distinct import distinct_poses
from coview_kernels.reference.field import field_scores, ground_heights, near_shifted, structure_at
from coview_kernels.reference.icp import align_planes
from coview_kernels.reference.nearest import nearest
from coview_kernels.reference.overhead import height_columns, lowest_heights, offsets_near
from coview_kernels.reference.polar import polar_bin, station_bins
from coview_kernels.reference.rays import cast_rays
from coview_kernels.reference.station_codes import best_codes, code_products, codes_at
from coview_kernels.reference.voxel_filter import transform_unique
from coview_kernels.reference.windows import window_products

__all__ = [
    "align_planes",
    "best_codes",
    "cast_rays",
    "code_products",
    "codes_at",
    "coview",
    "crop_points",
    "dense",
    "distinct_poses",
    "field_scores",
    "ground_heights",
    "height_columns",
    "lowest_heights",
    "near_shifted",
    "nearest",
    "offsets_near",
    "paper_context",
    "polar_bin",
    "station_bins",
    "structure_at",
    "transform_unique",
    "visible",
    "window_products",
]
