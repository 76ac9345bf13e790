# SPDX-License-Identifier: Apache-2.0
"""The numbers of docs/resuming.md."""

from nrfgs_lab.pages.tables import records


def times() -> str:
    """Seconds of writing and checking a checkpoint."""
    seconds = records("checkpoint_io")["seconds"]
    parts = "write and fsync", "checksum", "check the CRCs", "torch.load", "check the checksum"
    return ", ".join(f"{part} {seconds[part]:.1f} s" for part in parts)
