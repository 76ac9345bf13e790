# SPDX-License-Identifier: Apache-2.0
"""The table that ns-eval ends with."""

from nrfgs_ns.training.evaluation_table import far_below, print_evaluation


def views(*psnrs: float | None) -> list[dict]:
    return [
        {"image": f"{index}.png", **({} if value is None else {"psnr": value})} for index, value in enumerate(psnrs)
    ]


def test_views_far_below_the_rest_are_named_the_worst_first():
    found = far_below(views(25.0, 26.0, 12.0, 25.5, 26.5, 8.0, 25.2, 25.8, None))
    assert [name for name, *_ in found] == ["5.png", "2.png"]


def test_views_that_differ_as_views_do_are_not():
    assert far_below(views(20.0, 22.0, 24.0, 26.0, 28.0, 30.0)) == []  # spread widely
    assert far_below(views(25.0, 25.1, 25.0, 25.1, 25.0, 23.0)) == []  # spread little: 2 dB are not far
    assert far_below(views(25.0, 25.0, 25.0, 5.0)) == []  # too few
    assert far_below([]) == []


def test_the_table_has_what_was_measured(capsys):
    result = {"psnr": 25.25, "ssim": 0.8125, "lpips": None, "splats": 12345, "per_image": views(*[25.0] * 6, 9.0)}
    print_evaluation(result)
    said = capsys.readouterr().out
    assert "Means over 7 test views" in said and "25.25" in said and "12,345" in said and "lpips" not in said
    assert "6.png: 9.0 dB, 16.0 below the median view." in said
