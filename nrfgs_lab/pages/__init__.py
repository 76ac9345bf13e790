# SPDX-License-Identifier: Apache-2.0
"""What writes pages of the documentation: options, tables of numbers, the newcomer's page, pictures of the viewer."""
