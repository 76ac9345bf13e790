# SPDX-License-Identifier: Apache-2.0
"""What makes the start of each training in a process of tests quick."""

import gc

FREEZE, UNFREEZE = gc.freeze, gc.unfreeze


def keep_what_is_imported() -> None:
    """Keep the garbage collector off what there is, hundreds of thousands of objects, until `let_go`.

    Each training would walk through them, freeze them and thaw them again, which takes as long as ten of its steps.
    That it does is what `test_lifecycle.py` looks at.
    """
    gc.collect()
    FREEZE()
    gc.freeze = gc.unfreeze = lambda: None


def let_go() -> None:
    """Give everything back to the garbage collector: bindings in C++ complain of what is left when Python ends."""
    gc.freeze, gc.unfreeze = FREEZE, UNFREEZE
    UNFREEZE()
