"""Launches of a kernel whose arguments stay, prepared once instead of at every call.

A call of a Taichi 1.7 kernel costs 36 us, 22 us more for each array and 6 for each number (measured): types
are looked up, checked and converted every time. A :class:`Launch` sets the arguments once and afterwards
costs 4 us, plus 3 for an array that changes. It uses Taichi's own launch context, which is not public, so only
that of the versions it has been tested with; elsewhere (quadrants, which is quick by itself) it calls the
kernel.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from coview_kernels import runtime
from coview_kernels.front_end import tested

SPAN = 512
"""Iterations per chunk of a parallel loop.

Both libraries cut a range into blocks of at least 512 iterations for any ``block_dim``: a loop over C
chunks of work must run over ``C * SPAN`` and do the work in every SPAN-th iteration, or one thread does it all.
"""


class Launch:
    """Kernel of module ``_ti_<module>`` with its arguments; to be used on the owner thread, or as :meth:`ready` says.

    The arrays must be C-contiguous and of the types that the kernel declares, numbers Python's own: they are not
    checked. The arrays are kept alive here and may be written to between calls.
    """

    def __init__(self, module: str, name: str, *arguments: Any) -> None:
        self._name = (module, name)
        self._arguments = list(arguments)
        self._program: Any = None  # ends with a shutdown, and the context with it
        self._context: Any = None
        self._compiled: Any = None

    def put(self, index: int, value: Any) -> None:
        """Replace an argument, from now on."""
        self._arguments[index] = value
        if self._program is not None:
            _set_argument(self._context, index, value)

    def ready(self) -> bool:
        """Tell whether the kernel has run before in the program that runs now: from then on any thread may call it."""
        return self._program is not None and self._program is runtime.program()

    def __call__(self) -> None:
        """Run the kernel and wait for its end."""
        program = runtime.program()
        if self._program is not program:
            if not tested(runtime.library()):
                self._kernel()(*self._arguments)
                return
            self._prepare(program)
        program.launch_kernel(self._compiled, self._context)

    def _kernel(self) -> Any:
        module, name = self._name
        return getattr(runtime.kernels(module), name)

    def _prepare(self, program: Any) -> None:
        known, native, compiled = _compiled.get(self._name, (None, None, None))
        if known is not program:
            primal = self._kernel()._primal
            # the kernels declare all types, so that each has one compiled form
            native = primal.compiled_kernels[primal.ensure_compiled(*self._arguments)]
            compiled = program.compile_kernel(program.config(), program.get_device_caps(), native)
            _compiled[self._name] = program, native, compiled
        self._context, self._compiled = native.make_launch_context(), compiled
        for index, value in enumerate(self._arguments):
            _set_argument(self._context, index, value)
        self._program = program


_compiled: dict[tuple[str, str], tuple[Any, Any, Any]] = {}


def _set_argument(context: Any, index: int, value: Any) -> None:
    if isinstance(value, np.ndarray):
        address = value.__array_interface__["data"][0]
        context.set_arg_external_array_with_shape((index,), address, value.nbytes, value.shape, 0)
    elif isinstance(value, float):
        context.set_arg_float((index,), value)
    else:
        context.set_arg_int((index,), value)
