"""Start of a ROS 2 node with rclpy, its parameters as settings, its types and QoS."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from coview_stream.errors import ConfigError, DependencyError, install_command, printable

_NODE = "coview_stream"
_OWN_PARAMETERS = ("use_sim_time", "start_type_description_service")


def start_node(args: Sequence[str]) -> Any:
    """Return a ROS 2 node in its own context; ``args`` are the arguments after ``--ros-args``.

    Raises:
        DependencyError: rclpy is missing, or built for another Python. ConfigError: it refuses the arguments.
    """
    rclpy = _import_rclpy()
    context = rclpy.context.Context()
    try:
        signals = import_module("rclpy.signals").SignalHandlerOptions.NO  # the command ends the node
        rclpy.init(args=["--ros-args", *args], context=context, signal_handler_options=signals)
        return rclpy.node.Node(_NODE, context=context, automatically_declare_parameters_from_overrides=True)
    except Exception as error:  # its exception types differ between releases
        raise ConfigError(f"--ros-args {' '.join(args)}: {printable(error)}") from error


def _import_rclpy() -> Any:
    try:
        for name in ("context", "executors", "node", "qos"):
            import_module(f"rclpy.{name}")
        return import_module("rclpy")
    except Exception as error:  # a library of another release may raise anything
        spec = find_spec("rclpy")
        if spec is None:
            raise DependencyError(
                f"--ros2: there is no rclpy here; source ROS 2, or {install_command('ros2')} (Python 3.11 to 3.13)"
            ) from error
        folder = Path(spec.origin or "").parent
        built = sorted(path.name.split(".")[1] for path in folder.glob("_rclpy_pybind11.*.so"))
        tag = f"cpython-{sys.version_info.major}{sys.version_info.minor}"
        if built and not any(name.startswith(tag) for name in built):
            why = f"is built for {', '.join(built)}, and this is {tag}: use that Python"
        else:
            why = f"cannot be loaded ({printable(error)}): is ROS 2 sourced?"
        raise DependencyError(f"--ros2: the rclpy in {folder} {why}, or {install_command('ros2')}") from error


def settings_of(node: Any) -> dict[str, Any]:
    """Return a node's parameters, except its own; dots make tables. ConfigError if a name is a value and a table."""
    settings: dict[str, Any] = {}
    for name, parameter in sorted(node.get_parameters_by_prefix("").items()):
        if name in _OWN_PARAMETERS or name.startswith("qos_overrides."):
            continue
        *tables, last = name.split(".")
        table = settings
        for part in tables:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise ConfigError(f"ROS parameters: {name} and {part} are given: a table and a value of one name")
        value = parameter.value
        table[last] = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else value
    return settings


def latched(depth: int) -> Any:
    """Return a QoS that also delivers the newest ``depth`` messages to later subscribers."""
    qos = import_module("rclpy.qos")
    return qos.QoSProfile(depth=depth, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)


def message_type(name: str) -> Any:
    """Import a message type; DependencyError if its package is missing."""
    package, _, message = name.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), message)
    except ImportError as error:
        raise DependencyError(f"--ros2: ROS package {package} is missing; {install_command('ros2')}") from error
