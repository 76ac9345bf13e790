# SPDX-License-Identifier: Apache-2.0
"""Which images are for testing where a data set does not say so itself."""


def interior_test_images(count: int, every: int = 8) -> range:
    """Indices of the test images among `count` that are sorted by name: every eighth, beginning with index 4.

    Neither the first nor the last is taken: at the ends of a path there are training views on one side only, so that
    these images test extrapolation. (Of two images it is the first, of one that one.)
    """
    first = min(every // 2, (count - 1) // 2)
    return range(first, max(count - 1, first + 1), every)
