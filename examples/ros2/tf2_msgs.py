"""Build tf2_msgs, which the wheels of ROS 2 lack, for ``serve --ros2`` to publish TF: ``python tf2_msgs.py``.

Writes to the site-packages of this Python, or to the folder that is given. Needs gcc with C++ and Python's headers.
"""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np

MESSAGE = "geometry_msgs/TransformStamped[] transforms\n"
USED = "geometry_msgs", "std_msgs", "builtin_interfaces"


def build(folder: Path) -> None:
    """Generate the package by rosidl's own generators, and compile it into one library."""
    prefix, package = Path(sys.prefix), folder / "tf2_msgs"
    os.environ.setdefault("AMENT_PREFIX_PATH", str(prefix))
    from rosidl_adapter.msg import convert_msg_to_idl
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport

    (package / "msg").mkdir(parents=True, exist_ok=True)
    (package / "__init__.py").touch()
    (package / "msg/TFMessage.msg").write_text(MESSAGE)
    convert_msg_to_idl(package, "tf2_msgs", Path("msg/TFMessage.msg"), package / "msg")
    generators = (
        GenerateC("c"),
        GenerateFastRTPSCTypesupport("fastrtps_c"),
        GenerateCTypesupport("typesupport_c", typesupport_implementations=["rosidl_typesupport_fastrtps_c"]),
        GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c"]),
    )
    files = [
        file
        for each in generators
        for file in each.generate("tf2_msgs", [f"{package}:msg/TFMessage.idl"], [str(prefix / "share")], package)
    ]
    c, cpp = ([str(file) for file in files if str(file).endswith(end)] for end in (".c", ".cpp"))
    includes = [
        folder,
        np.get_include(),
        sysconfig.get_path("include"),
        prefix / "include",
        *(prefix / "include").iterdir(),
    ]
    layers = "generator_c", "generator_py", "typesupport_fastrtps_c", "typesupport_c"
    libraries = [f"{name}__rosidl_{layer}" for name in USED for layer in layers]
    libraries += ["rosidl_typesupport_fastrtps_cpp", "rosidl_typesupport_fastrtps_c", "rosidl_typesupport_c"]
    libraries += ["rosidl_runtime_c", "fastcdr", "rcutils", "stdc++"]
    subprocess.run(
        [
            *("gcc", "-w", "-fPIC", "-shared", "-o", package / "tf2_msgs_s__rosidl_typesupport_c.so"),
            *(f"-I{include}" for include in includes), *("-x", "c", *c, "-x", "c++", *cpp),
            *("-x", "none", f"-L{prefix / 'lib'}"), *(f"-l{library}" for library in libraries),
        ],
        check=True,
    )  # fmt: skip


if __name__ == "__main__":
    build(Path(sys.argv[1] if sys.argv[1:] else sysconfig.get_path("platlib")))
