# SPDX-License-Identifier: Apache-2.0
"""Whether trainings of 120 steps on a CPU end with the bits of an earlier commit's (`same bits` in results/tests.json).

    python tests/same_bits.py COMMIT [COMMIT ...] --data SCENE --out FOLDER

Prints for each training how many tensors of both last checkpoints are equal, of those that both have. What has been
trained is not trained again.
"""

import argparse
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
SUITED = "--pipeline.model.shrinkage 3 --pipeline.model.near-plane auto --pipeline.model.dense-start auto"
STRATEGY = "--pipeline.model.densification {},refine_every=10"
TRAININGS = {
    "nrfgs": STRATEGY.format("error-guided"),
    "nrfgs, 3DGS's rules": STRATEGY.format("original"),
    "nrfgs, MCMC": STRATEGY.format("mcmc,budget=12000"),
    "nrfgs, twin": f"--pipeline.model.twin on {STRATEGY.format('error-guided')}",
    "nrfgs-harmonics": STRATEGY.format("error-guided"),
    "nrfgs-harmonics, splatfacto's rules": STRATEGY.format("splatfacto"),
    "nrfgs-harmonics, twin": f"--pipeline.model.twin on {STRATEGY.format('error-guided')}",
    "nrfgs-vdgs": f"{SUITED} {STRATEGY.format('error-guided,budget=12000')}",
    "nrfgs-gsnb": f"{SUITED} {STRATEGY.format('error-guided,budget=12000')}",
    "nrfgs-deferred": f"{SUITED} {STRATEGY.format('error-guided,budget=12000')}",
    "nrfgs-latent-spec": f"{SUITED} {STRATEGY.format('error-guided,budget=12000')}",
}


def train(code: Path, name: str, data: Path, out: Path) -> Path | None:
    """The last checkpoint of a training by the code in a folder; None if that code lacks an option or the method."""
    if not list(out.glob("**/*.ckpt")):
        config = (code / "nrfgs_ns/model/config.py").read_text()
        twin = [] if "twin on" in TRAININGS[name] or "    twin:" not in config else ["--pipeline.model.twin", "off"]
        steps = ["--max-num-iterations", "120", "--schedule-steps", "30000", "--vis", "tensorboard"]
        options = [*steps, "--output-dir", str(out), "--data", str(data), *TRAININGS[name].split(), *twin]
        words = [name.partition(",")[0], *options, "nrfgs-data", "--downscale-factor", "8"]
        program = "from nerfstudio.scripts.train import entrypoint as e; e()"
        environment = os.environ | {"PYTHONPATH": str(code), "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
        subprocess.run([sys.executable, "-c", program, *words], env=environment, cwd=code, capture_output=True)
    return max(out.glob("**/*.ckpt"), default=None)


def digests(value, place: str = "") -> dict[str, str]:
    """The digests of the tensors in a checkpoint, by their places."""
    if isinstance(value, torch.Tensor):
        return {place: hashlib.sha256(value.detach().contiguous().numpy().tobytes()).hexdigest()}
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list | tuple) else ()
    return {at: digest for key, part in items for at, digest in digests(part, f"{place}/{key}").items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commits", nargs="+")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    data, out = options.data.resolve(), options.out.resolve()
    for commit in options.commits:
        (out / commit).mkdir(parents=True, exist_ok=True)
        archive = subprocess.run(["git", "archive", commit], cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout
        subprocess.run(["tar", "x", "-C", out / commit], input=archive, check=True)
    for name in TRAININGS:
        codes = {"here": ROOT, **{commit: out / commit for commit in options.commits}}
        last = {code: train(folder, name, data, out / "trained" / code / name) for code, folder in codes.items()}
        ends = {code: digests(torch.load(path, "cpu", weights_only=False)) for code, path in last.items() if path}
        for commit in options.commits:
            own, other = ends.get("here", {}), ends.get(commit, {})
            common = own.keys() & other.keys()
            equal = (
                f"{sum(own[at] == other[at] for at in common)} of {len(common)} tensors" if common else "not trained"
            )
            print(f"{name}, {commit}: {equal}", flush=True)


if __name__ == "__main__":
    main()
