# SPDX-License-Identifier: Apache-2.0
"""What the viewer shows: the pictures of a head, and the panel that chooses among them; and how it is served."""
