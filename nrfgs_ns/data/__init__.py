# SPDX-License-Identifier: Apache-2.0
"""Data sets: transforms.json and its points (dataparser), images in memory and their order (datamanager).

Nothing is imported here on purpose: nerfstudio loads `nrfgs_ns.data.dataparser` (an entry point) while its own
configuration modules are half imported, and `nrfgs_ns.data.datamanager` needs those modules whole.
"""
