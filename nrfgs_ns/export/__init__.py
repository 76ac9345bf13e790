# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export`: a trained model as a file that other programs read."""
