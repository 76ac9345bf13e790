# SPDX-License-Identifier: Apache-2.0
"""FLIP (Andersson et al., PACMCGIT 3(2), 2020): how different two pictures look, in [0, 1], lower is better. The
package `flip-evaluator` computes it (`pip install flip-evaluator`), at its 67 pixels a degree.
"""

import numpy as np

from nrfgs_ns.errors import InputError


def flip(pred: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Mean FLIP.

    Args:
        pred, truth: sRGB images [H, W, 3] in [0, 1].
        mask: bool [H, W], True inside: outside, the prediction is replaced by the truth, and left out of the mean.

    Returns:
        In [0, 1]; None if nothing is inside.

    Raises:
        InputError: `flip-evaluator` is missing.
    """
    try:
        import flip_evaluator
    except ImportError as error:
        raise InputError("FLIP needs the package flip-evaluator: pip install flip-evaluator") from error
    if mask is not None:
        if not mask.any():
            return None
        pred = np.where(mask[..., None], pred, truth)
    images = (np.ascontiguousarray(image, dtype=np.float32) for image in (truth, pred))
    errors = np.squeeze(flip_evaluator.evaluate(*images, "LDR", applyMagma=False)[0], axis=-1)
    return float(errors.mean() if mask is None else errors[mask].mean())
