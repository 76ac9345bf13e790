# SPDX-License-Identifier: Apache-2.0
"""Trained models: found, loaded and shown (`nrfgs view`)."""
