# SPDX-License-Identifier: Apache-2.0
"""The benchmark's scheduling with children that only pretend: resume, failures, stale records, GPUs, kills."""

import json
import os
import re
import signal
import sys
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
if behaviour == "fails": sys.exit(3)
if behaviour == "hangs":
    (Path(job["work"]) / "pid").write_text(str(os.getpid()))
    time.sleep(600)
if behaviour == "meets 4":
    (here / f"{name}.there").touch()
    until = time.monotonic() + 300
    while len(list(here.glob("*.there"))) < 4 and time.monotonic() < until:
        time.sleep(0.01)
seed = int(job["args"][job["args"].index("--machine.seed") + 1])
metrics = {"psnr": 20.0 + seed, "ssim": 0.9, "ms_ssim": None, "l1": 0.1, "lpips": None}
record = {
    "identity": job["identity"], "machine": {"device": "fake", "torch": "0"}, "jobs": job["jobs"], "wall_seconds": 1.0,
    "train": {"seconds": 10.0, "parts": 1, "splats": [[0, 10], [100, 20]]},
    "measured": {"test": metrics, "train": None, "fps": 5.0, "splats": 20, "parameter_bytes": 1, "checkpoint_bytes": 2},
}
if behaviour != "silent": Path(job["record"]).write_text(json.dumps(record))
with (here / "ran.txt").open("a") as file:
    file.write(f"{name} {os.environ.get('CUDA_VISIBLE_DEVICES')}\\n")
"""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """A benchmark of two methods on one scene whose children are the script above; its folder."""
    (tmp_path / "child.py").write_text(FAKE)
    (tmp_path / "behaviour.json").write_text("{}")
    for scene in ("scene", "other"):
        (tmp_path / "data" / scene).mkdir(parents=True)
        (tmp_path / "data" / scene / "transforms.json").write_text("{}")
    monkeypatch.setattr(bench, "CHILD", (sys.executable, str(tmp_path / "child.py")))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    handler = signal.getsignal(signal.SIGTERM)
    yield tmp_path
    signal.signal(signal.SIGTERM, handler)


FILE = "runs: {SH: nrfgs-sh, NRF: nrfgs}\nscenes: [scene]\nseeds: [1, 2]\nsteps: 100\n"


def bench_in(folder: Path, text: str = FILE, **options) -> Bench:
    (folder / "spec.yaml").write_text(text)
    place = {"scenes": folder / "data", "out": folder / "out", "work": folder / "work"}
    return Bench(spec=folder / "spec.yaml", **place, **options)


def ran(folder: Path) -> list[list[str]]:
    file = folder / "ran.txt"
    return [line.split() for line in file.read_text().splitlines()] if file.exists() else []


def behave(folder: Path, **behaviours: str) -> None:
    (folder / "behaviour.json").write_text(json.dumps(behaviours))


def table(folder: Path) -> str:
    return (folder / "out" / "table.md").read_text()


ALL = ["SH-own-scene-1", "NRF-own-scene-1", "SH-own-scene-2", "NRF-own-scene-2"]


def test_everything_is_run_once_and_reported(fake, capsys):
    bench_in(fake).main()
    assert [name for name, _ in ran(fake)] == ALL
    assert table(fake) in capsys.readouterr().out
    assert "| scene | NRF | own | 2 |" in table(fake) and "21.50 ± 0.71" in table(fake)
    assert (fake / "out" / "summary.json").stat().st_size > 0
    bench_in(fake).main()
    assert len(ran(fake)) == 4, "a finished run was repeated"


@pytest.mark.parametrize("run", ["nrfgs-shh", "{method: nrfgs, options: --pipeline.model.shrinkag 1}"])
def test_what_ns_train_refuses_is_told_before_the_first_run(run, fake):
    with pytest.raises(InputError, match="runs: NRF: ('nrfgs-shh' is no method of|ns-train refuses the op)"):
        bench_in(fake, FILE.replace("NRF: nrfgs", f"NRF: {run}")).main()
    assert not ran(fake)


def test_failures_are_listed_and_tried_again(fake):
    behave(fake, **{"NRF-own-scene-1": "fails", "NRF-own-scene-2": "silent"})
    with pytest.raises(SystemExit, match="2 of the runs FAILED: NRF-own-scene-1, NRF-own-scene-2"):
        bench_in(fake).main()
    assert "| scene | NRF | own | 0 (2 FAILED) |" in table(fake)
    behave(fake)
    bench_in(fake).main()
    assert "| scene | NRF | own | 2 |" in table(fake)
    assert sorted(name for name, _ in ran(fake)).count("SH-own-scene-1") == 1
    assert not list((fake / "out" / "runs").glob("*.failed"))


def test_parts_of_a_file_report_all_that_is_there(fake):
    """Runs, seeds and scenes of the same file, asked for one after the other."""
    text = FILE.replace("runs: {", "runs: {no split: {method: nrfgs, options: --pipeline.model.shrinkage 1}, ")
    text = text.replace("[scene]", "[scene, {path: other, downscale: 2}]")

    def rows(**chosen) -> list[list[str]]:
        bench_in(fake, text, **chosen).main()
        rows = json.loads((fake / "out" / "summary.json").read_text())
        return [[row[key] for key in ("scene", "run", "seeds")] for row in rows if row["scene"] != "average"]

    assert rows(runs=("NRF",), data=("scene",), seeds=(1,)) == [["scene", "NRF", [1]]]
    both = [["scene", "no split", [2]], ["scene", "NRF", [1]]]
    assert rows(runs=("no split",), data=("./scene/",), seeds=(2,)) == both
    assert rows(runs=("NRF",), data=("other",), seeds=(1,)) == [*both, ["other", "NRF", [1]]]
    assert len(ran(fake)) == 3
    parser = json.loads((fake / "out" / "runs" / "NRF-own-other-1.json").read_text())["identity"]["parser"]
    assert parser[0] == "nrfgs-data" and parser[-2:] == ["--downscale-factor", "2"], "read as the file says"


@pytest.mark.parametrize("stop, status", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_benchmark_takes_its_children_along(stop, status, fake, monkeypatch):
    """No traceback, the status of a stopped command, and no child left; the next call does the rest."""
    behave(fake, **{"NRF-own-scene-1": "hangs"})
    command, pid = bench_in(fake, seeds=(1,)), fake / "work" / "NRF-own-scene-1" / "pid"
    sleep = time.sleep

    def pressed(seconds: float) -> None:
        os.kill(os.getpid(), stop) if pid.exists() and pid.read_text() else sleep(seconds)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as ended:
        patch.setattr(cli, "chosen", lambda arguments: command)
        patch.setattr(bench.time, "sleep", pressed)
        cli.entrypoint()
    assert ended.value.code == status
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)
    behave(fake)
    bench_in(fake, seeds=(1,)).main()
    assert [name for name, _ in ran(fake)] == ALL[:2]


def test_records_of_other_arguments_are_refused_named_and_redone(fake, capsys):
    bench_in(fake, seeds=(1,)).main()
    said = "2 of the records.*SH-own-scene-1 had options: --max-num-iterations 100.*--redo-stale"
    with pytest.raises(InputError, match=said):
        bench_in(fake, seeds=(1,), steps=50).main()
    assert len(ran(fake)) == 2
    (fake / "data" / "scene" / "transforms.json").rename(fake / "elsewhere")  # a report needs no data
    bench_in(fake, steps=50, report_only=True).main()
    (fake / "elsewhere").rename(fake / "data" / "scene" / "transforms.json")
    assert "| scene | NRF | own | 0 (1 stale, 1 missing) |" in table(fake) and len(ran(fake)) == 2
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
    assert "10.0" not in table(fake) and "Time and FPS are left out" in table(fake)


def test_more_gpus_than_there_are_are_refused(monkeypatch):
    """A child on a GPU that is not there would train on the CPU."""
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    assert gpu_names(1) == ["0"] and gpu_names(2) == ["0", "1"]
    with pytest.raises(InputError, match="there are 2. Ask for at most 2"):
        gpu_names(4)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    assert gpu_names(1) == ["3"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert gpu_names(1) == [""], "GPUs that were hidden stay hidden"


def test_a_plan_with_knobs_reports_the_trade(fake):
    """A knob or a single setting is chosen by its name; the default is always there."""
    knobs = "default: nrfgs\nscenes: [scene]\nseeds: [1, 2]\nsteps: 100\nknobs: {steps: {steps: [50]}, "
    knobs += "D: {option: --viewer.jpeg-quality, values: [4, 8]}, head: {settings: {SH: nrfgs-sh}}}\n"
    bench_in(fake, knobs, runs=("D 8", "head")).main()
    runs = ("default", "D_8", "head_SH")
    assert {name for name, _ in ran(fake)} == {f"{run}-own-scene-{seed}" for run in runs for seed in (1, 2)}
    text = (fake / "out" / "tradeoff.md").read_text()
    assert re.findall(r"^\| ([*\w ]+) \| 2 \|", text, re.MULTILINE) == ["**default**", "D 8", "head SH"]
    assert (fake / "out" / "tradeoff.png").exists() and "| D 8 | 2 | (+0.00)" in text
