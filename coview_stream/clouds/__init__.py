"""Point clouds and trajectories: read, write, filter."""

from __future__ import annotations

from coview_stream.clouds.cloud import Cloud, merge
from coview_stream.clouds.files import CLOUD_SUFFIXES, read_cloud, write_cloud
from coview_stream.clouds.trajectory import read_tum, write_tum

__all__ = ["CLOUD_SUFFIXES", "Cloud", "merge", "read_cloud", "read_tum", "write_cloud", "write_tum"]
