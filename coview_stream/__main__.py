"""``python -m coview_stream`` is the ``coview-stream`` command."""

from __future__ import annotations

import sys

from coview_stream.cli import main

sys.exit(main())
