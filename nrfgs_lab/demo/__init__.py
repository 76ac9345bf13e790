# SPDX-License-Identifier: Apache-2.0
"""`nrfgs demo`: make a glossy scene whose truth is known, train field and harmonics on it, compare them."""
