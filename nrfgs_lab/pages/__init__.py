# SPDX-License-Identifier: Apache-2.0
"""What pages of the documentation are made by: options, tables of numbers, the newcomer's page, pictures of the viewer."""
