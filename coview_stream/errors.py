"""The one error tree.

CoViewError
├── ConfigError      an option or a configuration field is out of its range
├── InputError       a file, run or array that the caller gave cannot be used
│   ├── CloudError   a point cloud is unreadable, empty, truncated or of another format
│   ├── RunError     a run's frames and odometry do not fit together
│   ├── MapError     a ``.coview`` file is damaged, of another version or not a map
│   └── MessageError a message from the network cannot be decoded
│       └── EncodingError   nobody here knows its encoding
├── TransportError   the network session cannot be opened or configured
└── DependencyError  an optional or native library is missing; the message names the remedy

Every message names the file, field or key and what to do. The CLI prints it as one line and exits with 2.
"""

from __future__ import annotations


class CoViewError(Exception):
    """Root of all errors that coview_stream raises on purpose."""


class ConfigError(CoViewError, ValueError):
    """An option or configuration field is out of its range."""


class InputError(CoViewError, ValueError):
    """Something the caller handed over cannot be used."""


class CloudError(InputError):
    """A point cloud is unreadable, empty, truncated or in another format."""


class RunError(InputError):
    """A run's frames, odometry or stamps do not fit together."""


class MapError(InputError):
    """A base map file is damaged, of another version, or not a base map at all."""


class MessageError(InputError):
    """A message from the network is malformed: truncated, oversized, or not what its encoding says."""


class EncodingError(MessageError):
    """No codec knows a message's encoding."""


class TransportError(CoViewError):
    """A network session cannot be opened, or its configuration is wrong."""


class DependencyError(CoViewError, ImportError):
    """A library that this operation needs is missing; the message says how to get it."""
