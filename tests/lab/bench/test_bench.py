# SPDX-License-Identifier: Apache-2.0
"""The benchmark's scheduling with children that only pretend: resume, failures, stale records, GPUs, kills."""

import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from nrfgs_lab.bench import command as bench
from nrfgs_lab.bench.command import Bench, gpu_names
from nrfgs_ns import cli
from nrfgs_ns.errors import InputError

FAKE = """
import json, os, sys, time
from pathlib import Path

job = json.loads(Path(sys.argv[1]).read_text())
name, here = Path(job["record"]).stem, Path(__file__).parent
behaviours = json.loads((here / "behaviour.json").read_text())
behaviour = behaviours.get(name, behaviours.get("all", "good"))
Path(job["work"]).mkdir(parents=True, exist_ok=True)
if behaviour == "fails":
    sys.exit(3)
if behaviour == "hangs":
    (Path(job["work"]) / "pid").write_text(str(os.getpid()))
    time.sleep(600)
if behaviour == "meets 4":
    (here / f"{name}.there").touch()
    while len(list(here.glob("*.there"))) < 4:
        time.sleep(0.01)
seed = int(job["args"][job["args"].index("--machine.seed") + 1])
metrics = {"psnr": 20.0 + seed, "ssim": 0.9, "ms_ssim": None, "l1": 0.1, "lpips": None}
record = {
    "identity": job["identity"], "machine": {"device": "fake", "torch": "0"}, "jobs": job["jobs"], "wall_seconds": 1.0,
    "train": {"seconds": 10.0, "parts": 1, "splats": [[0, 10], [100, 20]]},
    "measured": {"test": metrics, "train": None, "fps": 5.0, "splats": 20, "parameter_bytes": 1, "checkpoint_bytes": 2},
}
if behaviour != "silent":
    Path(job["record"]).write_text(json.dumps(record))
with (here / "ran.txt").open("a") as file:
    file.write(f"{name} {os.environ.get('CUDA_VISIBLE_DEVICES')}\\n")
"""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """A benchmark of two methods on one scene whose children are the script above; its folder."""
    (tmp_path / "child.py").write_text(FAKE)
    (tmp_path / "behaviour.json").write_text("{}")
    (tmp_path / "data" / "scene").mkdir(parents=True)
    (tmp_path / "data" / "scene" / "transforms.json").write_text("{}")
    monkeypatch.setattr(bench, "CHILD", (sys.executable, str(tmp_path / "child.py")))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    handler = signal.getsignal(signal.SIGTERM)
    yield tmp_path
    signal.signal(signal.SIGTERM, handler)


def bench_in(folder: Path, **more) -> Bench:
    options = {"data": ("scene",), "runs": ("SH=nrfgs-sh", "NRF=nrfgs"), "seeds": (1, 2), "steps": 100, **more}
    return Bench(scenes=folder / "data", out=folder / "out", work=folder / "work", **options)


def ran(folder: Path) -> list[list[str]]:
    """Name and GPU of each child that came to its end."""
    file = folder / "ran.txt"
    return [line.split() for line in file.read_text().splitlines()] if file.exists() else []


def behave(folder: Path, **behaviours: str) -> None:
    (folder / "behaviour.json").write_text(json.dumps(behaviours))


ALL = {"SH-own-scene-1", "NRF-own-scene-1", "SH-own-scene-2", "NRF-own-scene-2"}


def test_everything_is_run_once_and_reported(fake, capsys):
    bench_in(fake).main()
    assert [name for name, _ in ran(fake)] == [
        "SH-own-scene-1",
        "NRF-own-scene-1",
        "SH-own-scene-2",
        "NRF-own-scene-2",
    ]
    table = (fake / "out" / "table.md").read_text()
    assert table in capsys.readouterr().out
    assert "| scene | NRF | own | 2 |" in table and "21.50 ± 0.71" in table
    for file in ("summary.json", "splats.png"):
        assert (fake / "out" / file).stat().st_size > 0
    bench_in(fake).main()
    assert len(ran(fake)) == 4, "a finished run was repeated"


def test_what_is_no_method_is_told_before_the_first_run(fake):
    file = spec_file(fake, "runs: {SH: nrfgs-sh, NRF: nrfgs-shh}\nscenes: [scene]\nsteps: 100\n")
    whole = bench_in(fake, spec=file, runs=(), data=(), seeds=())
    with pytest.raises(InputError, match="runs: NRF: 'nrfgs-shh' is no method of ns-train"):
        whole.main()
    assert not ran(fake)
    bench_in(fake, spec=file, runs=("SH",), data=(), seeds=()).main()
    assert len(ran(fake)) == 1


def test_failures_are_listed_and_tried_again(fake):
    behave(fake, **{"NRF-own-scene-1": "fails", "NRF-own-scene-2": "silent"})
    with pytest.raises(SystemExit, match="2 of the runs FAILED: NRF-own-scene-1, NRF-own-scene-2"):
        bench_in(fake).main()
    assert "| scene | NRF | own | 0 (2 FAILED) |" in (fake / "out" / "table.md").read_text()
    assert json.loads((fake / "out/runs/NRF-own-scene-1.failed").read_text())["returncode"] == 3
    behave(fake)
    bench_in(fake).main()
    assert "| scene | NRF | own | 2 |" in (fake / "out" / "table.md").read_text()
    assert sorted(name for name, _ in ran(fake)).count("SH-own-scene-1") == 1
    assert not list((fake / "out" / "runs").glob("*.failed"))


def test_parts_of_a_file_report_all_that_is_there(fake):
    """Runs, seeds, scenes and strategies of the same file, asked for one after the other."""
    (fake / "data" / "other").mkdir()
    (fake / "data" / "other" / "transforms.json").write_text("{}")
    file = spec_file(
        fake,
        "runs: {no split: {method: nrfgs, options: --x 1}, SH: nrfgs-sh, NRF: nrfgs}\n"
        "scenes: [scene, {path: other, downscale: 2}]\nseeds: [1, 2]\nsteps: 100\nstrategies: [original, mcmc@9]\n",
    )

    def rows(**chosen) -> list[list[str]]:
        bench_in(fake, **{"spec": file, "runs": (), "data": (), "seeds": (), "steps": None, **chosen}).main()
        return [row[:3] + row[4:5] for row in summaries(fake)]

    assert rows(runs=("NRF",), data=("scene",), seeds=(1,), strategies=("mcmc@9",)) == [["scene", "NRF", "mcmc@9", [1]]]
    assert rows(runs=("no split",), data=("scene",), seeds=(2,), strategies=("mcmc@9",)) == [
        ["scene", "no split", "mcmc@9", [2]],
        ["scene", "NRF", "mcmc@9", [1]],
    ]
    shown = rows(runs=("NRF",), data=("other",), seeds=(1,), strategies=("original",))
    assert [row for row in shown if row[3] and row[0] != "average"] == [
        ["scene", "no split", "mcmc@9", [2]],
        ["scene", "NRF", "mcmc@9", [1]],
        ["other", "NRF", "original", [1]],
    ]
    assert all(row[1] != "SH" for row in shown), "a run that nobody asked for and that has left nothing"
    assert len(ran(fake)) == 3
    record = json.loads((fake / "out" / "runs" / "NRF-original-other-1.json").read_text())
    parser = record["identity"]["parser"]
    assert parser[0] == "nrfgs-data" and parser[-2:] == ["--downscale-factor", "2"], "read as the file says"


def summaries(folder: Path) -> list[list]:
    """scene, run, strategy, absent, seeds of each row of the report."""
    rows = json.loads((folder / "out" / "summary.json").read_text())
    return [[row[key] for key in ("scene", "run", "strategy", "absent", "seeds")] for row in rows]


def test_a_report_made_while_another_command_runs(fake):
    """It has what is there, and the other one's report has all in the end."""
    file = spec_file(fake, "runs: {SH: nrfgs-sh, NRF: nrfgs}\nscenes: [scene]\nseeds: [1]\nsteps: 100\n")
    chosen = {"spec": file, "data": (), "seeds": (), "steps": None}
    bench_in(fake, runs=("SH",), **chosen).main()
    reports = []
    other = bench_in(fake, runs=("NRF",), **chosen)
    wait = other.start

    def start(*job):
        bench_in(fake, runs=(), report_only=True, **chosen).main()
        reports.extend(summaries(fake))
        return wait(*job)

    other.start = start
    other.main()
    assert reports == [["scene", "SH", "own", {}, [1]], ["scene", "NRF", "own", {"1": "missing"}, []]]
    assert summaries(fake) == [["scene", "SH", "own", {}, [1]], ["scene", "NRF", "own", {}, [1]]]


def test_a_stopped_benchmark_says_so(fake, monkeypatch, capsys):
    """Ctrl-C: no traceback, the status of a stopped command, and no child left."""
    behave(fake, **{"SH-own-scene-1": "hangs"})
    command, pid = bench_in(fake, seeds=(1,)), fake / "work" / "SH-own-scene-1" / "pid"
    monkeypatch.setattr(cli, "chosen", lambda arguments: command)

    def stop(_):
        if pid.exists() and pid.read_text():
            raise KeyboardInterrupt

    monkeypatch.setattr(bench.time, "sleep", stop)
    with pytest.raises(SystemExit) as ended:
        cli.entrypoint()
    assert ended.value.code == 130 and "nrfgs: stopped" in capsys.readouterr().err
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "5", '{"identity": {}}', '{"identity": {}, "machine": {}, "jobs": 1, "train": {}, "measured": null}'],
)
def test_a_broken_record_is_named(text, fake):
    bench_in(fake, seeds=(1,)).main()
    (fake / "out" / "runs" / "SH-own-scene-1.json").write_text(text)
    with pytest.raises(InputError, match="SH-own-scene-1.json is no.*Remove it"):
        bench_in(fake, seeds=(1,)).main()


def spec_file(folder: Path, text: str) -> Path:
    (folder / "spec.yaml").write_text(text)
    return folder / "spec.yaml"


def test_report_only_runs_nothing_and_needs_no_data(fake):
    bench_in(fake, seeds=(1,)).main()
    (fake / "data" / "scene" / "transforms.json").unlink()
    bench_in(fake, report_only=True).main()
    assert len(ran(fake)) == 2
    assert "| scene | SH | own | 1 (1 missing) |" in (fake / "out" / "table.md").read_text()


def test_records_of_other_arguments_are_refused_named_and_redone(fake, capsys):
    bench_in(fake, seeds=(1,)).main()
    with pytest.raises(
        InputError, match="2 of the records.*SH-own-scene-1 had options: --max-num-iterations 100.*--redo-stale"
    ):
        bench_in(fake, seeds=(1,), steps=50).main()
    assert len(ran(fake)) == 2
    bench_in(fake, seeds=(1,), steps=50, report_only=True).main()
    assert "| scene | NRF | own | 0 (1 stale) |" in (fake / "out" / "table.md").read_text()
    assert "SH-own-scene-1 is stale" in capsys.readouterr().out
    bench_in(fake, seeds=(1,), steps=50, redo_stale=True).main()
    assert len(ran(fake)) == 4
    assert len(list((fake / "out" / "runs").glob("*.stale"))) == 2
    bench_in(fake, seeds=(1,), steps=50).main()
    assert len(ran(fake)) == 4


def test_runs_share_gpus_as_they_are_told(fake, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,7,9")
    behave(fake, all="meets 4")  # each waits for the three others
    bench_in(fake, jobs=2, gpus=2).main()
    assert sorted(gpu for _, gpu in ran(fake)) == ["5", "5", "7", "7"]
    table = (fake / "out" / "table.md").read_text()
    assert "10.0" not in table and "Time and FPS are left out" in table


def test_more_gpus_than_there_are_is_refused(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    assert gpu_names(1) == ["3"]
    with pytest.raises(InputError, match="at most 1"):
        gpu_names(2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert gpu_names(1) == [""], "GPUs that were hidden stay hidden"


def test_gpus_that_the_machine_lacks_are_refused(monkeypatch):
    """A child on a GPU that is not there would train on the CPU."""
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    assert gpu_names(1) == ["0"] and gpu_names(2) == ["0", "1"]
    with pytest.raises(InputError, match="this machine has 2. Ask for at most 2"):
        gpu_names(4)


def test_a_terminated_benchmark_takes_its_children_along(fake):
    behave(fake, **{"NRF-own-scene-1": "hangs"})
    script = textwrap.dedent(
        f"""
        import sys
        from pathlib import Path
        from nrfgs_lab.bench import command as bench
        bench.CHILD = (sys.executable, {str(fake / "child.py")!r})
        folder = Path({str(fake)!r})
        bench.Bench(scenes=folder / "data", out=folder / "out", work=folder / "work", data=("scene",),
                    runs=("SH=nrfgs-sh", "NRF=nrfgs"), seeds=(1,), steps=100).main()
        """
    )
    process = subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.DEVNULL)
    pid = fake / "work" / "NRF-own-scene-1" / "pid"
    while not (pid.exists() and pid.read_text()):
        assert process.poll() is None
        time.sleep(0.05)
    child = int(pid.read_text())
    process.terminate()
    process.wait()
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)
    assert (fake / "out" / "runs" / "SH-own-scene-1.json").exists()
    behave(fake)
    bench_in(fake, seeds=(1,)).main()
    assert [name for name, _ in ran(fake)] == ["SH-own-scene-1", "NRF-own-scene-1"]


def test_flags_have_precedence_over_the_file(fake):
    (fake / "spec.yaml").write_text("runs: {A: nrfgs}\nscenes: [other]\nsteps: 5\nseeds: [9]\njobs: 3\n")
    plan, (cell,) = Bench(spec=fake / "spec.yaml", data=("scene",), steps=7, runs=("B=nrfgs-sh --x 1",)).chosen()
    assert (plan.steps, plan.seeds, plan.jobs) == (7, [9], 3) and cell.scene.name == "scene"
    assert (cell.run.name, cell.run.method, cell.run.options) == ("B", "nrfgs-sh", ("--x", "1"))
    assert chosen_runs(runs=("nrfgs", "nrfgs-sh"), data=("x",)) == [
        ("nrfgs", "nrfgs", ()),
        ("nrfgs-sh", "nrfgs-sh", ()),
    ]
    with pytest.raises(InputError, match="runs is missing"):
        Bench(data=("x",)).chosen()


def chosen_runs(**options) -> list[tuple]:
    """Name, method and options of each chosen run."""
    _, cells = Bench(**options).chosen()
    return list(dict.fromkeys((cell.run.name, cell.run.method, cell.run.options) for cell in cells))


FILE = """
runs:
  no split: {method: nrfgs, options: --x False, steps: 9}
  NRF-GS: nrfgs
  nrfgs-sh: {method: nrfgs-sh, options: --degree 1}
  5: nrfgs-vdgs
scenes: [{path: garden, downscale: 4}, other]
"""


def test_runs_are_chosen_by_name(tmp_path):
    """A run of the file, with its options; else a method. A name that is both is the file's."""
    file = spec_file(tmp_path, FILE)

    def runs(*words):
        return chosen_runs(spec=file, runs=words)

    assert runs("no split", "NRF-GS") == [("no split", "nrfgs", ("--x", "False")), ("NRF-GS", "nrfgs", ())]
    assert runs("nrfgs-sh", "5") == [("nrfgs-sh", "nrfgs-sh", ("--degree", "1")), ("5", "nrfgs-vdgs", ())]
    assert runs("nrfgs", "nrfgs-sg --y 1") == [("nrfgs", "nrfgs", ()), ("nrfgs-sg --y 1", "nrfgs-sg", ("--y", "1"))]
    assert runs("no split=nrfgs --x True") == [("no split", "nrfgs", ("--x", "True"))]
    assert runs("a=nrfgs --machine.x=3") == [("a", "nrfgs", ("--machine.x=3",))]
    for word in ("no opacity", "a=nrf"):
        with pytest.raises(InputError, match="no method of ns-train.*has no run of that name. It has 5, NRF-GS, no sp"):
            runs("NRF-GS", word)
    assert chosen_runs(runs=("splatfacto",), data=("x",)) == [("splatfacto", "splatfacto", ())]
    whole, part = Bench(spec=file).chosen(), Bench(spec=file, runs=("no split",), data=("./garden/",)).chosen()
    assert part[1] == whole[1][:1] and part[1][0].scene.downscale == 4


def test_time_that_is_up_leaves_the_rest_for_the_next_call(fake, capsys):
    behave(fake, **{"NRF-own-scene-1": "hangs"})

    class Clock:
        sleep, monotonic = staticmethod(time.sleep), staticmethod(lambda: 0.0 if not hung.exists() else 61.0)

    hung = fake / "work" / "NRF-own-scene-1" / "pid"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "time", Clock)
        bench_in(fake, minutes=1.0).main()
    assert [name for name, _ in ran(fake)] == ["SH-own-scene-1"] and "3 runs are left" in capsys.readouterr().err
    behave(fake)
    bench_in(fake).main()
    assert sorted(name for name, _ in ran(fake)) == sorted(ALL)


def test_a_plan_with_knobs_reports_the_trade(fake):
    """A knob or a single setting is chosen by its name; the default is always there."""
    knobs = "default: nrfgs\nscenes: [scene]\nseeds: [1, 2]\nsteps: 100\n"
    knobs += "knobs: {D: {option: --d, values: [4, 8]}, head: {settings: {SH: nrfgs-sh}}, steps: {steps: [50]}}\n"
    file = spec_file(fake, knobs)
    bench_in(fake, spec=file, runs=("D 8", "head"), data=(), seeds=(), steps=None).main()
    assert {name for name, _ in ran(fake)} == {
        f"{run}-own-scene-{seed}" for run in ("default", "D_8", "head_SH") for seed in (1, 2)
    }
    text = (fake / "out" / "tradeoff.md").read_text()
    assert re.findall(r"^\| ([*\w ]+) \| 2 \|", text, re.MULTILINE) == ["**default**", "D 8", "head SH"]
    assert (fake / "out" / "tradeoff.png").exists() and "| D 8 | 2 | (+0.00)" in text
    with pytest.raises(
        InputError, match="'E' is no method.*It has D, D 4, D 8, default, head, head SH, steps, steps 50"
    ):
        Bench(spec=file, runs=("E",)).chosen()
