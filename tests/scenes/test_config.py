# SPDX-License-Identifier: Apache-2.0
"""Bad values are refused by name."""

import math

import pytest

from nrfgs_ns.scenes import SceneConfig


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gloss", -0.1),
        ("gloss", 1.01),
        ("gloss", math.nan),
        ("gloss", "shiny"),
        ("mirror", -0.1),
        ("mirror", 2),
        ("views", 1),
        ("views", 4.0),
        ("width", 0),
        ("height", -3),
        ("samples", 0),
        ("points", 0),
        ("test_every", 1),
        ("seed", -1),
        ("seed", True),
        ("field_of_view", 0.0),
        ("field_of_view", 121.0),
    ],
)
def test_bad_values_name_the_field_and_the_value(field, value):
    with pytest.raises(ValueError, match=f"SceneConfig.{field} must .*got {value!r}"):
        SceneConfig(**{field: value})


def test_focal_length_spans_the_field_of_view():
    config = SceneConfig(width=200, field_of_view=90.0)
    assert config.focal_length == pytest.approx(100.0)
