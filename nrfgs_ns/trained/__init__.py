# SPDX-License-Identifier: Apache-2.0
"""Trained models: found, loaded, evaluated (`nrfgs eval`) and shown (`nrfgs view`)."""
