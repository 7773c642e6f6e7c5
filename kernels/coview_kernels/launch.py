"""Kernel launches with fixed arguments, prepared once instead of at every call.

A kernel call costs 15 us in quadrants 1.3 and 36 in Taichi 1.7, and 5 to 20 us more per argument (measured), because
types are looked up, checked and converted every time. A :class:`Launch` sets the arguments once and afterwards costs
4 us, plus 3 for an array that changes. Without it a filter of 20,000 points takes 1.7 times as long, an alignment of
1,500 points 1.4 times, a small call 5 times (commit 731ba9db, bench/speed). The library's launch context is not public,
so a launch uses it only in tested versions, and otherwise calls the kernel.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from coview_kernels import runtime

TESTED_VERSIONS = {"quadrants": ((1, 3), (1, 4)), "taichi": ((1, 7),)}
"""Versions of the libraries whose launch context is known."""

SPAN = 512
"""Iterations per chunk of a parallel loop.

Both libraries cut a range into blocks of at least 512 iterations for any ``block_dim``. A loop over C chunks of work
must therefore run over ``C * SPAN`` and work in every SPAN-th iteration, or one thread does everything.
"""


def tested(library: Any) -> bool:
    """Return whether the launch context of this version is known."""
    return tuple(library.__version__[:2]) in TESTED_VERSIONS.get(library.__name__, ())


class Launch:
    """Kernel of module ``_ti_<module>`` with its arguments, for the owner thread, or others if :meth:`ready`.

    Arguments are not checked: arrays must be C-contiguous with the kernel's declared types, numbers Python's own. The
    launch keeps the arrays alive; they may be written to between calls.
    """

    def __init__(self, module: str, name: str, *arguments: Any) -> None:
        self._name = (module, name)
        self._arguments = list(arguments)
        self._program: Any = None  # a shutdown ends it and the context
        self._context: Any = None
        self._compiled: Any = None

    def put(self, index: int, value: Any) -> None:
        """Replace an argument for later calls."""
        self._arguments[index] = value
        if self.ready():
            _set_argument(self._context, index, value)

    def ready(self) -> bool:
        """Return whether the kernel has run in the current program, after which any thread may call it."""
        return self._program is not None and self._program is runtime.program()

    def __call__(self) -> None:
        """Run the kernel and wait for its end."""
        program: Any = runtime.program()
        if self._program is program:
            program.launch_kernel(self._compiled, self._context)
        elif self._name in _compiled and _compiled[self._name][0] is program:
            self._prepare(program)
            program.launch_kernel(self._compiled, self._context)
        else:
            module, name = self._name
            kernel = getattr(runtime.kernels(module), name)
            kernel(*self._arguments)
            if tested(runtime.library()):
                _compiled[self._name] = program, *_forms(kernel._primal, program)
                self._prepare(program)

    def _prepare(self, program: Any) -> None:
        _, native, self._compiled = _compiled[self._name]
        self._context = native.make_launch_context()
        for index, value in enumerate(self._arguments):
            _set_argument(self._context, index, value)
        self._program = program


_compiled: dict[tuple[str, str], tuple[Any, Any, Any]] = {}


def _forms(kernel: Any, program: Any) -> tuple[Any, Any]:
    """Return the parsed and the compiled form of a kernel that has run; there is one, as all types are declared."""
    if runtime.library().__name__ == "quadrants":
        return next(iter(kernel.materialized_kernels.values())), next(iter(kernel.compiled_kernel_data_by_key.values()))
    native = next(iter(kernel.compiled_kernels.values()))
    return native, program.compile_kernel(program.config(), program.get_device_caps(), native)


def _set_argument(context: Any, index: int, value: Any) -> None:
    place: Any = index if runtime.library().__name__ == "quadrants" else (index,)
    if isinstance(value, np.ndarray):
        address = value.__array_interface__["data"][0]
        context.set_arg_external_array_with_shape(place, address, value.nbytes, value.shape, 0)
    elif isinstance(value, float):
        context.set_arg_float(place, value)
    else:
        context.set_arg_int(place, value)
