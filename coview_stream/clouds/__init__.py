"""Point clouds and runs: read, write, filter."""

from __future__ import annotations

from coview_stream.clouds.cloud import Cloud, merge
from coview_stream.clouds.readers import CLOUD_SUFFIXES, read_cloud
from coview_stream.clouds.runs import Frame, Run, open_run
from coview_stream.clouds.trajectory import read_tum, write_tum
from coview_stream.clouds.writers import write_cloud

__all__ = [
    "CLOUD_SUFFIXES",
    "Cloud",
    "Frame",
    "Run",
    "merge",
    "open_run",
    "read_cloud",
    "read_tum",
    "write_cloud",
    "write_tum",
]
