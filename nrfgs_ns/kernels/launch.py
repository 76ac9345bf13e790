# SPDX-License-Identifier: Apache-2.0
"""Launching a Triton kernel again and again, with less work for the host.

Each `kernel[grid](...)` looks at every argument to find the compiled variant: its type, whether a pointer is aligned,
whether an integer is 1 or a multiple of 16. For thirty arguments that takes longer than a small kernel. Kernels that
are only ever given tensors of the same dtypes, and integers that Triton is told not to specialise
(`do_not_specialize`), have one variant for each set of constants, as long as all pointers are aligned. So the first
launch is Triton's own, and the variant it used is launched from then on.
"""

from typing import Any

import torch
import triton

ALIGNMENT = 16
"""Bytes by which Triton tells pointers apart; parts of PyTorch's allocations may be unaligned."""
MAX_INT = 2**31 - 1
"""Larger integers are of another type, and the kernel another variant."""
KEEPS_CONSTANTS = tuple(int(part) for part in triton.__version__.split(".")[:2]) >= (3, 6)
"""Whether a compiled kernel takes all of the function's arguments, constants too."""


class Launcher:
    """One kernel, for callers that always pass the same dtypes.

    Args:
        kernel: under `triton.jit`; its plain arguments, with integers not specialised, come before its constants.
    """

    def __init__(self, kernel: Any):
        self.kernel = kernel
        self.variants: dict[tuple, tuple[Any, tuple]] = {}

    def __call__(self, grid: tuple[int, int, int], *arguments: torch.Tensor | int | float, **constants: Any) -> None:
        """Launch a grid of programs with plain arguments, the first a tensor, constants, and the compiler's options."""
        kinds: list[Any] = []
        plain: list[int | float] = []  # a tensor by its address: asked for it, Triton's launcher also asks the driver
        ordinary = True
        for argument in arguments:
            kind = type(argument)
            if kind is int:
                ordinary = ordinary and -MAX_INT <= argument <= MAX_INT
            elif kind is not float:
                kind = None
                argument = argument.data_ptr()
                ordinary = ordinary and argument % ALIGNMENT == 0
            kinds.append(kind)
            plain.append(argument)
        key = (arguments[0].get_device(), *kinds, *constants.items())
        variant = self.variants.get(key)
        if variant is not None and ordinary:
            compiled, in_order = variant
            compiled[grid](*plain, *in_order)
            return
        compiled = self.kernel[grid](*arguments, **constants)
        if compiled is not None and ordinary and KEEPS_CONSTANTS:  # the interpreter compiles nothing
            self.variants[key] = compiled, tuple(constants[name] for name in self.kernel.arg_names[len(arguments) :])
