# SPDX-License-Identifier: Apache-2.0
"""Images: what is made of a rendering before it is compared with a photograph, and how the two are compared."""
