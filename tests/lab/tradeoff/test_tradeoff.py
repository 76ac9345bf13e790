# SPDX-License-Identifier: Apache-2.0
"""Knobs become a benchmark, its records become a front and prices, and noise is called noise."""

import json
import math
from dataclasses import replace

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.text import Text
from scipy.stats import t as student

from nrfgs_lab.bench.spec import cells_of, command, identity, make_spec, steps_of
from nrfgs_lab.bench.table import Row
from nrfgs_lab.tradeoff.analysis import (
    BY_NAME,
    COSTS,
    PSNR,
    Change,
    changes,
    front_of,
    noise_bound,
    pareto_front,
    pooled_deviation,
    price,
)
from nrfgs_lab.tradeoff.command import Tradeoff
from nrfgs_lab.tradeoff.figure import best_place, draw
from nrfgs_lab.tradeoff.plan import Setting, bench_plan
from nrfgs_lab.tradeoff.report import report
from nrfgs_ns.errors import InputError

D = "--pipeline.model.appearance.latent-dim"
KNOBS = {
    "default": {"method": "nrfgs", "options": "--a 1"},
    "scenes": ["s"],
    "seeds": [1, 2],
    "steps": 100,
    "knobs": {
        "D": {"option": D, "values": [4, 8]},
        "steps": {"steps": [50]},
        "budget": {"strategies": ["mcmc@200"]},
        "precision": {"option": "--p", "values": ["fp32"], "cuda": True},
        "head": {"settings": {"SH": {"method": "nrfgs-sh", "options": "--b 2"}, "one": {"options": "--c 3"}}},
    },
}


def planned(cuda=False, only=(), **changes):
    content, settings = bench_plan({**KNOBS, **changes}, "knobs.yaml", cuda, only)
    return make_spec(yaml.safe_load(yaml.safe_dump(content, sort_keys=False)), "bench.yaml"), settings


def test_knobs_become_runs():
    spec, settings = planned()
    runs = {run.name: run for run in spec.runs}
    assert [setting.name for setting in settings] == list(runs)
    assert list(runs) == ["default", "D 4", "D 8", "steps 50", "budget mcmc@200", "head SH", "head one"]
    assert runs["D 4"].options == ("--a", "1", D, "4") and runs["D 4"].method == "nrfgs"
    assert runs["steps 50"].steps == 50 and runs["default"].steps is None
    assert runs["budget mcmc@200"].strategies == ("mcmc@200",)
    assert runs["head SH"].method == "nrfgs-sh" and runs["head SH"].options == ("--b", "2")  # not the default's
    assert runs["head one"].options == ("--a", "1", "--c", "3")
    # Every setting once for each seed; a run's own steps are in its command and in what its record is compared with.
    assert len(cells_of(spec)) == 7 * 2
    cell = next(cell for cell in cells_of(spec) if cell.run.name == "steps 50")
    assert steps_of(spec, cell.run) == 50
    assert ["--max-num-iterations", "50"] == command(spec, cell, [], "w")[5:7]
    assert "50" in identity(spec, cell, None)["options"]


def test_gpu_knobs_and_chosen_knobs():
    assert "precision fp32" in [setting.name for setting in planned(cuda=True)[1]]
    assert [setting.name for setting in planned(only=("D",))[1]] == ["default", "D 4", "D 8"]
    chosen = planned(only=("D 8", "head"))[1]
    assert [setting.name for setting in chosen] == ["default", "D 8", "head SH", "head one"]
    with pytest.raises(InputError, match="no knob D 5. It has D, steps, budget, precision, head; a single setting"):
        planned(only=("D 5",))


@pytest.mark.parametrize(
    "change, words",
    [
        ({"knobs": {}}, "knobs is missing"),
        ({"knobs": {"D": {"values": [1]}}}, "exactly one of option, steps"),
        ({"knobs": {"D": {"option": D, "steps": [1]}}}, "exactly one of"),
        ({"knobs": {"D": {"option": D}}}, "values"),
        ({"knobs": {"D": {"option": D, "values": [1], "cude": True}}}, "unknown key cude"),
        ({"knobs": {"D": {"option": D, "values": [1, 1.0, 1]}}}, None),
        ({"knobs": {"steps": {"steps": 5}}}, "must be a list"),
        ({"knobs": {"head": {"settings": {"x": {"option": "--a"}}}}}, "x may have method"),
        ({"knobs": {"a": {"settings": {"b c": {}}}, "a b": {"settings": {"c": {}}}}}, "there twice"),
        ({"knobs": {"head": {"settings": {"x": {"options": None}}}}}, "head x: options must be a string or a list"),
        ({"knobs": {"head": {"settings": {"x": {"options": "'"}}}}}, "options cannot be told apart"),
        ({"default": {"options": "--a"}}, "default names no method"),
        ({"runs": {"x": "nrfgs"}}, "Leave runs out"),
        ({"strategies": ["splatfacto", "original"]}, "strategies names several"),
    ],
)
def test_a_bad_file_is_named(change, words):
    if words is None:  # equal values are one setting
        assert [setting.name for setting in planned(**change)[1]] == ["default", "D 1", "D 1.0"]
        return
    with pytest.raises(InputError, match=words):
        planned(**change)
    with pytest.raises(InputError, match="no knob E"):
        planned(only=("E",))


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12))
def test_front_is_what_nothing_beats(points):
    """Against the definition, on a grid so coarse that ties are common."""

    def beats(a, b):
        return a[0] <= b[0] and a[1] >= b[1] and a != b

    expected = {i for i, point in enumerate(points) if not any(beats(other, point) for other in points)}
    front = pareto_front(points)
    assert set(front) == expected and len(front) == len(expected)
    assert [points[i][0] for i in front] == sorted(points[i][0] for i in front)


def test_pooled_deviation_by_hand():
    # Variances 2 (1 degree of freedom) and 1 (2): s^2 = (2 + 2) / 3. A sample of one adds nothing.
    deviation, freedom = pooled_deviation([[1.0, 3.0], [4.0, 5.0, 6.0], [9.0]])
    assert freedom == 3 and deviation == pytest.approx(math.sqrt(4 / 3))
    bound = noise_bound(deviation, freedom, 2, 3)
    assert bound == pytest.approx(student.ppf(0.975, 3) * math.sqrt(4 / 3) * math.sqrt(1 / 2 + 1 / 3))
    assert pooled_deviation([[1.0], [2.0]]) == (None, 0) and noise_bound(None, 0, 1, 1) == math.inf


def record(psnr, seconds=10.0, fps=50.0, size=2e6, jobs=1):
    return {
        "identity": {},
        "machine": {"device": "a card", "torch": "2.11"},
        "jobs": jobs,
        "train": {"seconds": seconds, "parts": 1, "splats": [[0, 10], [100, 20]], "peak_memory_bytes": None},
        "measured": {
            "test": {"psnr": psnr, "ssim": 0.9, "ms_ssim": None, "l1": 0.01, "lpips": None},
            "train": None,
            "fps": fps,
            "splats": 20,
            "parameter_bytes": size,
            "checkpoint_bytes": 3 * size,
        },
    }


def row(name, *records):
    return Row("s", name, "own", dict(enumerate(records))).fill()


def test_differences_inside_the_noise_are_marked():
    """One deviation for all: pairs 0.2 apart have s = 0.1414, 3 degrees of freedom, so the bound is
    t(3) 0.1414 = 3.182 * 0.1414 = 0.450."""
    rows = [
        row("default", record(30.0), record(30.2)),
        row("near", record(30.4), record(30.6)),
        row("far", record(30.5), record(30.7)),
    ]
    result = changes(rows, rows[0], PSNR, ratio=False)
    assert result["near"].value == pytest.approx(0.4) and result["near"].is_noise
    assert result["far"].value == pytest.approx(0.5) and not result["far"].is_noise
    assert result["far"].noise == pytest.approx(0.4501, abs=1e-4)
    # One seed each: nothing can be told.
    single = [row("default", record(30.0)), row("far", record(40.0))]
    assert changes(single, single[0], PSNR, ratio=False)["far"].is_noise


def test_costs_are_ratios_of_geometric_means():
    rows = [
        row("default", record(30.0, seconds=10.0), record(30.0, seconds=40.0)),
        row("half", record(30.0, seconds=5.0), record(30.0, seconds=20.0)),
        row("shared", record(30.0, jobs=2), record(30.0, jobs=2)),
    ]
    result = changes(rows, rows[0], BY_NAME["time s"], ratio=True)
    assert result["half"].value == pytest.approx(0.5)
    # The same spread, a factor of 4, in both: s = ln 4 / sqrt 2, 2 degrees of freedom, bound t(2) s = 4.303 * 0.980.
    assert result["half"].noise == pytest.approx(math.exp(4.3027 * math.log(4) / math.sqrt(2)), rel=1e-4)
    assert result["half"].is_noise and "shared" not in result  # its time was not measured alone


def test_prices():
    def ratio(value):
        return Change(value, 1.05, True)

    up, down, nothing = Change(0.6, 0.1), Change(-0.6, 0.1), Change(0.05, 0.1)
    assert price(up, ratio(4.0)) == ("trade", pytest.approx(0.3))
    assert price(down, ratio(0.25)) == ("trade", pytest.approx(0.3))
    assert price(up, ratio(0.25), power=-1) == ("trade", pytest.approx(0.3))  # a quarter of the frames
    assert price(up, ratio(0.5)) == ("better", None) and price(down, ratio(2.0)) == ("worse", None)
    assert price(up, ratio(0.97)) == ("gain", None) and price(down, ratio(1.0)) == ("loss", None)
    assert price(nothing, ratio(2.0)) == ("noise", None) and price(nothing, ratio(1.02)) == ("same", None)


def test_front_by_frames_wants_many():
    rows = [row("slow", record(32.0, fps=10.0)), row("fast", record(30.0, fps=90.0)), row("bad", record(29.0, fps=50))]
    assert front_of(rows, next(cost for cost in COSTS if cost.power < 0)) == ["fast", "slow"]


def test_report_from_records(tmp_path, capsys):
    """Two scenes, one setting failed on the second: fronts and table of each, and of the average where both are."""
    knobs = {**KNOBS, "scenes": ["s", "t"], "knobs": {"D": {"option": D, "values": [4, 8]}}}
    content, settings = bench_plan(knobs, "knobs.yaml", False)
    spec = make_spec(content, "bench.yaml")
    quality = {"default": 30.0, "D 4": 29.0, "D 8": 30.01}
    seconds = {"default": 10.0, "D 4": 5.0, "D 8": 9.0}
    (tmp_path / "runs").mkdir()
    for cell in cells_of(spec):
        file = tmp_path / "runs" / f"{cell.name}.json"
        if cell.scene.name == "t" and cell.run.name == "D 8":
            file.with_suffix(".failed").write_text("{}")
            continue
        jitter = 0.01 * (cell.seed - 1)
        name = cell.run.name
        file.write_text(json.dumps(record(quality[name] + jitter, seconds[name] * (1 + jitter))))
    report(spec, settings, tmp_path, {})
    results = {result["scene"]: result for result in json.loads((tmp_path / "tradeoff.json").read_text())}
    assert list(results) == ["s", "t", "average"]
    assert results["s"]["fronts"]["training time"] == ["D 4", "D 8"]
    assert results["t"]["fronts"]["training time"] == ["D 4", "default"]
    by_run = {one["run"]: one for one in results["s"]["settings"]}
    # Half the time for 1 dB: 1 dB per doubling. 0.01 dB is noise; nothing is known of memory, and bytes are the same.
    assert by_run["D 4"]["prices"]["training time"] == ["trade", pytest.approx(1.0)]
    assert by_run["D 8"]["changes"]["PSNR"]["is_noise"] and by_run["D 8"]["prices"]["training time"][0] == "noise"
    assert by_run["D 4"]["changes"]["peak MB"] is None
    text = (tmp_path / "tradeoff.md").read_text()
    assert "| D 4 | 2 | -1.00 |" in text and "| D 8 | 2 | (+0.01) |" in text and "2 FAILED" in text
    assert (tmp_path / "tradeoff.png").stat().st_size > 5000
    assert "D 8" in capsys.readouterr().out


@pytest.fixture
def no_figure(monkeypatch):
    """Reports without the figure, which takes a second; other tests draw it."""
    monkeypatch.setattr("nrfgs_lab.tradeoff.report.draw", lambda rows, settings, path: None)


@pytest.mark.usefixtures("no_figure")
def test_costs_are_absolute_where_the_default_has_none(tmp_path, capsys):
    """The default shared its GPU on scene t, whose other times are known all the same. On s there are factors, and a
    footnote only where a reader meets such a number."""
    knobs = {**KNOBS, "scenes": ["s", "t"], "seeds": [1], "knobs": {"D": {"option": D, "values": [4, 8]}}}
    content, settings = bench_plan(knobs, "knobs.yaml", False)
    spec = make_spec(content, "bench.yaml")
    (tmp_path / "runs").mkdir()
    for cell in cells_of(spec):
        is_shared = cell.scene.name == "t" and cell.run.name != "D 4"
        made = record(30.0, seconds=269.94, fps=459.23, jobs=3 if is_shared else 1)
        (tmp_path / "runs" / f"{cell.name}.json").write_text(json.dumps(made))

    def lines(scene):
        """Run -> its cells; the head is that of no name."""
        part = (tmp_path / "tradeoff.md").read_text().split(f"### {scene}\n\n")[1].split("\n\n")[0]
        words = [[word.strip("* ") for word in line.split("|")[1:]] for line in part.splitlines()]
        return {name: cells for name, *cells in words}

    report(spec, settings, tmp_path, {})
    time, fps = lines("s")[""].index("training time"), lines("s")[""].index("FPS")
    assert [lines("s")[run][time] for run in ("default", "D 4")] == ["269.9", "[x 1.00]"]
    assert [lines("t")[run][time] for run in ("default", "D 4", "D 8")] == ["-", "269.9 s", "-"]
    assert [lines("t")[run][fps] for run in ("default", "D 4", "D 8")] == ["-", "459.2 FPS", "-"]
    assert lines("average")["D 4"][time] == "269.9 s"
    footnote = "Numbers with a unit"
    assert footnote in (tmp_path / "tradeoff.md").read_text()
    report(replace(spec, scenes=spec.scenes[:1]), settings, tmp_path, {})
    assert footnote not in (tmp_path / "tradeoff.md").read_text()


@pytest.mark.parametrize("count", [1, 2, 12])
def test_names_keep_inside_the_frame_and_apart(tmp_path, monkeypatch, count):
    """On a front of as many settings with long names, the last of them at the upper right; one knob has no point."""
    from matplotlib import pyplot

    names = [Setting("default", ""), *(Setting("a long knob", f"at value {i}") for i in range(1, count))]
    rows = [row(one.name, record(20.0 + i, 10.0 * 1.1**i, 50.0 / 1.1**i, 1e6 * 1.1**i)) for i, one in enumerate(names)]
    empty = Setting("fewer steps", "5")
    monkeypatch.setattr(pyplot, "close", lambda figure: None)
    try:
        draw([*rows, Row("s", empty.name, "own").fill()], [*names, empty], tmp_path / "figure.png")
        figure = pyplot.gcf()
        assert [text.get_text() for text in figure.legends[0].get_texts()] == ["default", "a long knob"][:count]
        for panel in figure.axes:
            assert {text.get_text() for text in panel.texts} == {one.name for one in names}
            boxes = [Text.get_window_extent(text) for text in panel.texts]
            for i, box in enumerate(boxes):
                assert panel.bbox.x0 <= box.x0 and box.x1 <= panel.bbox.x1
                assert panel.bbox.y0 <= box.y0 and box.y1 <= panel.bbox.y1
                assert not any(box.overlaps(other) for other in boxes[:i])
    finally:
        monkeypatch.undo()
        pyplot.close(pyplot.gcf())


def test_a_name_goes_where_it_disturbs_least():
    """A name of 20 x 10 pixels at a point in the middle of a panel of 100 x 100, at one pixel for a point of type."""
    middle, size, frame = (50.0, 50.0), (20.0, 10.0), (0.0, 0.0, 100.0, 100.0)
    disturbed, (x, y), box = best_place(middle, size, frame, [], 1.0)
    assert disturbed == 0 and x > -10 and y > 0 and box == (50 + x, 50 + y, 70 + x, 60 + y)
    right = [(50.0, 0.0, 100.0, 100.0)]
    disturbed, (x, y), _ = best_place(middle, size, frame, right, 1.0)
    assert disturbed == 0 and x <= -20
    # With everything taken, it lies over 20 x 10 pixels of that, and not outside, where nothing is taken.
    disturbed, _, box = best_place((98.0, 98.0), size, frame, [frame], 1.0)
    assert disturbed == pytest.approx(200) and box[2] <= 100 and box[3] <= 100


def test_names_off_the_front_need_room(tmp_path, monkeypatch):
    """Sixty settings in one place: the one on the front has its name, and of the others not all."""
    from matplotlib import pyplot

    names = [Setting("default", ""), *(Setting("knob", f"at quite a long value {i}") for i in range(60))]
    rows = [row(one.name, record(20.0 - (i > 0), 10.0 + 1e-4 * i)) for i, one in enumerate(names)]
    monkeypatch.setattr(pyplot, "close", lambda figure: None)
    try:
        draw(rows, names, tmp_path / "figure.png")
        shown = [text.get_text() for text in pyplot.gcf().axes[0].texts]
        assert "default" in shown and 1 < len(shown) < len(names)
    finally:
        monkeypatch.undo()
        pyplot.close(pyplot.gcf())


def test_a_training_without_a_splat_has_no_ratio():
    empty = record(5.0)
    empty["measured"]["splats"] = 0
    rows = [row("default", record(30.0)), row("empty", empty)]
    assert set(changes(rows, rows[0], BY_NAME["splats"], ratio=True)) == {"default"}


def test_strange_names_break_no_table(tmp_path):
    """A knob whose name means something to Markdown and to matplotlib."""
    content, settings = bench_plan({**KNOBS, "knobs": {"_a|b $": {"steps": [50]}}}, "knobs.yaml", False)
    spec = make_spec(content, "bench.yaml")
    (tmp_path / "runs").mkdir()
    for cell in cells_of(spec):
        (tmp_path / "runs" / f"{cell.name}.json").write_text(json.dumps(record(30.0)))
    report(spec, settings, tmp_path, {})
    assert r"| \_a\|b $ 50 | 2 |" in (tmp_path / "tradeoff.md").read_text()


@pytest.fixture
def fake_runs(monkeypatch):
    """Names of the trainings that a benchmark would make; each leaves a record at once."""
    from nrfgs_lab.bench import command as bench

    ran = []
    monkeypatch.setattr(
        bench.Bench, "parsers", lambda self, plan: {s: ["nrfgs-data", "--data", "d"] for s in plan.scenes}
    )

    def run_all(self, pending, plan):
        ran.extend(pending)
        (self.out / "runs").mkdir(parents=True, exist_ok=True)
        for name, job in pending.items():
            self.record(name).write_text(json.dumps({**record(30.0), "identity": job.identity}))

    monkeypatch.setattr(bench.Bench, "run_all", run_all)
    return ran


def test_the_command_runs_a_benchmark(tmp_path, fake_runs):
    """It leaves the benchmark's file, hands it to `nrfgs bench` with its options, and reports what that has left."""
    ran = fake_runs
    (tmp_path / "knobs.yaml").write_text(yaml.safe_dump({**KNOBS, "knobs": {"D": KNOBS["knobs"]["D"]}}))
    command = Tradeoff(tmp_path / "knobs.yaml", out=tmp_path / "out", work=tmp_path / "work", seeds=(7,), cuda=False)
    command.main()
    assert ran == ["default-own-s-7", "D_4-own-s-7", "D_8-own-s-7"]
    assert yaml.safe_load((tmp_path / "out" / "bench.yaml").read_text())["seeds"] == [7]
    assert (tmp_path / "out" / "tradeoff.md").exists() and (tmp_path / "out" / "table.md").exists()
    ran.clear()
    command.main()
    assert ran == []


def test_rows_with_steps_of_their_own_are_named(tmp_path, fake_runs, capsys):
    """A file's "a third of the steps" is no third of others."""
    (tmp_path / "knobs.yaml").write_text(yaml.safe_dump(KNOBS))
    command = Tradeoff(tmp_path / "knobs.yaml", out=tmp_path, work=tmp_path, knobs=("steps", "D"), steps=40, cuda=False)
    command.main()
    assert "--steps does not change runs that have their own: steps 50 (50)." in capsys.readouterr().out
    with pytest.raises(InputError, match="steps is 0"):
        Tradeoff(tmp_path / "knobs.yaml", out=tmp_path / "none", steps=0).main()


@pytest.mark.usefixtures("no_figure")
def test_parts_of_a_sweep_report_all_that_is_there(tmp_path, fake_runs):
    """Knobs one after the other, a report without a GPU of what was made with one."""
    (tmp_path / "knobs.yaml").write_text(
        yaml.safe_dump({**KNOBS, "scenes": [{"path": "s", "downscale": 2}, "t"]}, sort_keys=False)
    )

    def sweep(**chosen) -> tuple[list[str], list]:
        """The rows of the report on the first scene, and its seeds."""
        command = Tradeoff(tmp_path / "knobs.yaml", out=tmp_path / "out", work=tmp_path / "work", data=("s",), **chosen)
        command.main()
        first = json.loads((tmp_path / "out" / "tradeoff.json").read_text())[0]
        content = yaml.safe_load((tmp_path / "out" / "bench.yaml").read_text())
        assert list(content["runs"]) == [one["run"] for one in first["settings"]]
        assert content["scenes"] == [{"path": "s", "downscale": 2}]
        return list(content["runs"]), content["seeds"]

    assert sweep(knobs=("precision",), seeds=(1,), cuda=True) == (["default", "precision fp32"], [1])
    assert sweep(knobs=("D 4",), seeds=(1,), cuda=False) == (["default", "D 4", "precision fp32"], [1])
    assert len(fake_runs) == 3
    fake_runs.clear()
    assert sweep(knobs=("D 4",), seeds=(3,), cuda=False) == (["default", "D 4", "precision fp32"], [1, 3])
    assert fake_runs == ["default-own-s-3", "D_4-own-s-3"]
    fake_runs.clear()
    everything = ["default", "D 4", "D 8", "steps 50", "budget mcmc@200", "precision fp32", "head SH", "head one"]
    assert sweep(report_only=True, cuda=False) == (everything, [1, 2])  # 3 is not in the file
    assert fake_runs == []
