# SPDX-License-Identifier: Apache-2.0
"""`nrfgs bench`: trainings side by side, measured alike, and their tables."""
