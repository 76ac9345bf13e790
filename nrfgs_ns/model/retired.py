# SPDX-License-Identifier: Apache-2.0
"""Options of older versions that this one does not have. A config.yml may hold them; nothing reads them."""

RETIRED = {"consistent": "splatfacto"}
"""Strategies of densification that are no more -> the one whose statistics theirs were."""


class CapacitySearch:
    """Of `--pipeline.model.capacity auto`; what it left of a head is in the checkpoint."""


class ConsistentDensification:
    """Of `--pipeline.model.densification consistent`."""


class DiffuseSplats:
    """Of `--pipeline.model.diffuse`; which splats are diffuse is in the checkpoint."""
