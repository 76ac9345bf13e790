# SPDX-License-Identifier: Apache-2.0
"""A quick start of each training in a process of tests."""

import gc

FREEZE, UNFREEZE = gc.freeze, gc.unfreeze


def keep_what_is_imported() -> None:
    """Keep the garbage collector off all that is imported, until `let_go`.

    Each training would walk through hundreds of thousands of objects, freeze them and thaw them again, which takes as
    long as ten of its steps. `test_lifecycle.py` checks that it does.
    """
    gc.collect()
    FREEZE()
    gc.freeze = gc.unfreeze = lambda: None


def let_go() -> None:
    """Give everything back to the garbage collector: bindings in C++ complain of what is left when Python ends."""
    gc.freeze, gc.unfreeze = FREEZE, UNFREEZE
    UNFREEZE()
