"""``python -m coview_stream`` is the ``coview-stream`` command."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path

with suppress(OSError):  # the directory may be gone
    _HERE = str(Path.cwd())
    # ``-m`` searches the current directory first, where an unrelated numpy.py may lie; a checkout that is not
    # installed is still found there
    if not sys.flags.safe_path and sys.path[0] == _HERE:
        sys.path.append(sys.path.pop(0))

from coview_stream.cli import main

sys.exit(main())
