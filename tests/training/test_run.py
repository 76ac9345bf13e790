# SPDX-License-Identifier: Apache-2.0
"""What a record says of its version; an evaluation as a table."""

from pathlib import Path

import pytest

import nrfgs_ns
from nrfgs_lab.training_run import digest_of, machine
from nrfgs_ns.training.evaluation import far_below, print_evaluation


def test_the_digest_is_of_names_and_contents(tmp_path):
    def digest(files: dict[str, bytes]) -> str:
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        return digest_of(folder)

    files = {"a.py": b"x = 1\n", "part/b.py": b""}
    same = {**files, "part/c.txt": b"notes"}, {**files, "a.py": b"x = 1\r\n"}
    others = {**files, "a.py": b"x = 2\n"}, {**files, "c.py": b""}, {"a.py": b"", "part/b.py": b"x = 1\n"}
    assert {digest(each) for each in same} == {digest(files)}
    assert digest(files) not in [digest(each) for each in others]
    assert machine()["source"] == digest_of(Path(nrfgs_ns.__file__).parent)


def views(*psnrs: float | None) -> list[dict]:
    return [
        {"image": f"{index}.png", **({} if value is None else {"psnr": value})} for index, value in enumerate(psnrs)
    ]


@pytest.mark.parametrize(
    ("psnrs", "names"),
    [
        ((25.0, 26.0, 12.0, 25.5, 26.5, 8.0, 25.2, 25.8, None), ["5.png", "2.png"]),
        ((20.0, 22.0, 24.0, 26.0, 28.0, 30.0), []),  # spread widely
        ((25.0, 25.1, 25.0, 25.1, 25.0, 23.0), []),  # spread little: 2 dB are not far
        ((25.0, 25.0, 25.0, 5.0), []),  # too few
    ],
)
def test_views_far_below_the_rest_are_named_the_worst_first(psnrs, names):
    assert [name for name, *_ in far_below(views(*psnrs))] == names


def test_the_table_has_what_was_measured(capsys):
    result = {"psnr": 25.25, "ssim": 0.8125, "lpips": None, "splats": 12345, "per_image": views(*[25.0] * 6, 9.0)}
    print_evaluation(result)
    said = capsys.readouterr().out
    assert "Means over 7 test views" in said and "25.25" in said and "12,345" in said and "lpips" not in said
    assert "6.png: 9.0 dB, 16.0 below the median view." in said
    print_evaluation({"psnr": 25.25, "per_image": views(25.25)})
    assert "One test view: not a mean" in capsys.readouterr().out
