# SPDX-License-Identifier: Apache-2.0
"""Triton's interpreter without the half of its time that changes nothing. Importing it is enough."""

import triton.language as tl
from triton.runtime.interpreter import InterpretedFunction

as_it_was = InterpretedFunction.__call__


def call(self, *args, **kwargs):
    """Call a device function. The interpreter replaces all of `triton.language`'s functions by its own before every
    such call; a kernel's launch, or another call, has mostly done that already."""
    languages = [value for value in self.fn.__globals__.values() if value is tl or value is tl.core]
    if any(tl.core.is_builtin(language.load) for language in languages):
        return as_it_was(self, *args, **kwargs)
    return self.rewrite()(*args, **kwargs)


InterpretedFunction.__call__ = call
