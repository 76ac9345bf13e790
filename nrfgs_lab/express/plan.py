# SPDX-License-Identifier: Apache-2.0
"""What is fitted to what: models at one budget, learning rates to choose from, variations and the sweep over sizes.

The budget is what harmonics of degree 3 take: 48 numbers for each sample. A cell is one fit (or one bound), described
by data alone, so that its record says everything and a rerun knows whether it has been done.
"""

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from nrfgs_lab.express.fit import FitConfig
from nrfgs_lab.express.models import (
    DirectionalModel,
    FactoredHarmonics,
    Field,
    Harmonics,
    LearntBasis,
    Lobes,
    SplitField,
    largest,
)

Setup = Literal["synthetic", "pixels", "image"]
KINDS: dict[str, type[DirectionalModel]] = {
    "harmonics": Harmonics,
    "field": Field,
    "split-field": SplitField,
    "lobes": Lobes,
    "learnt-basis": LearntBasis,
    "factored-harmonics": FactoredHarmonics,
}
SH_NUMBERS = 48
"""Numbers per sample of harmonics of degree 3."""
FIELD_NUMBERS, FIELD_SHARED = 35, 4227
"""Numbers per sample and shared weights of the study's field."""
PAPER_COUNTS = {328: (15_744, 15_707), 160_000: (7_680_000, 5_604_227)}
"""Samples -> parameters of harmonics and field, as the paper has them (there 7.68M and 5.60M)."""
IMAGE_MODELS = ("sh", "nrf", "nrf-2-bands", "nrf-split", "sg", "gsnb", "vdgs-like")
"""Rows of the image, where each fit takes minutes. GSNB in full is within a thousandth of the budget there."""
OVER_BUDGET = {"gsnb"}
"""Models that take more than the budget: all coefficients of degree 3, and a network."""
RATES = ((0.01, 0.003), (0.01, 0.01), (0.03, 0.003), (0.03, 0.01), (0.1, 0.003), (0.1, 0.01))
"""Learning rates tried: what samples store, shared weights."""
SAMPLE_RATES = ((0.01, 0.01), (0.03, 0.01), (0.1, 0.01), (0.3, 0.01))
"""The same for models that share nothing."""
RATE_SEED = 1000
"""Seed of the targets on which rates are chosen: none that is reported."""
DIRECTIONS = {f"directions-{count}": {"directions": count} for count in (24, 48, 192)}
TARGET_CHANGES: dict[Setup, dict[str, dict[str, Any]]] = {
    "synthetic": {
        **DIRECTIONS,
        "scattered": {"scattered": True},
        "decaying": {"by_degree": tuple((1 + degree) ** -2.0 for degree in range(6))},
        "degrees-4-and-5": {"by_degree": (0.0, 0.0, 0.0, 0.0, 1.0, 1.0)},
        "degree-5": {"by_degree": (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)},
        "grey": {"grey": True},
        **{f"factors-{count}": {"factors": count} for count in (8, 16, 32, 64)},
        "lobe": {"lobes": 1},
        "grey-lobe": {"lobes": 1, "grey": True},
    },
    "pixels": {**DIRECTIONS, "matter": {"gloss": (0.0, 0.75)}},
    "image": {
        "small": {},
        "matter": {"gloss": (0.0, 0.75)},
        **{f"one-material-{rank:g}": {"gloss": (rank, rank)} for rank in (0.25, 0.5, 0.75)},
    },
}
"""Set-up -> name -> arguments of the targets: what the paper's may have been, as far as it does not say."""
LOW_DIMENSIONAL = ("degree-5", "grey", "factors-8", "grey-lobe")
"""Targets that few numbers describe: fitted with more passes, too."""


@dataclass(frozen=True)
class ModelSpec:
    """A model, as data."""

    kind: str
    """one of KINDS"""
    sizes: dict[str, Any] = field(default_factory=dict)
    """its arguments where they differ from the defaults"""

    def build(self) -> DirectionalModel:
        return KINDS[self.kind](**self.sizes)

    def but(self, **sizes: Any) -> "ModelSpec":
        """The same with other arguments."""
        return replace(self, sizes={**self.sizes, **sizes})


@dataclass(frozen=True)
class Cell:
    """One number of the study."""

    name: str
    """of its record"""
    group: Literal["rate", "main", "vary", "sweep"]
    setup: Setup
    label: str
    """of the row that it belongs to"""
    seed: int
    model: ModelSpec | None
    """None: the bound of linear codes"""
    fit: FitConfig | None
    """None: least squares (harmonics), or nothing to fit"""
    targets: dict[str, Any] = field(default_factory=dict)
    """arguments of the targets where they differ from the defaults"""

    def settings(self) -> dict[str, Any]:
        """Everything that determines the result but the data, for the record."""
        return {key: value for key, value in asdict(self).items() if key != "name"}


def models(num_samples: int) -> dict[str, ModelSpec]:
    """Row label -> model, each at most the budget of harmonics for so many samples, but for OVER_BUDGET."""
    budget = SH_NUMBERS * num_samples

    def fitted(kind: str, size: str, sizes: range, **others: Any) -> ModelSpec:
        spec = ModelSpec(kind, others)
        return spec.but(**{size: largest(lambda n: spec.but(**{size: n}).build(), sizes, num_samples, budget)})

    specs = {
        "sh": ModelSpec("harmonics"),
        "nrf": ModelSpec("field"),
        "nrf-2-bands": ModelSpec("field", {"bands": 2}),
        "nrf-bounded": ModelSpec("field", {"bound": 0.2}),
        "nrf-split": fitted("split-field", "width", range(1, 65)),
        "sg": ModelSpec("lobes"),
        "gsnb": ModelSpec("learnt-basis"),
        "gsnb-small": fitted("learnt-basis", "width", range(1, 65), degree=2),
        "vdgs-like": fitted("factored-harmonics", "features", range(1, 17)),
    }
    check_counts(num_samples, specs)
    return specs


def check_counts(num_samples: int, specs: dict[str, ModelSpec]) -> None:
    """Hold the counts against the paper's and the budget.

    Raises:
        AssertionError: a model has another size than the study says.
    """
    sh, nrf = specs["sh"].build().count(num_samples), specs["nrf"].build().count(num_samples)
    assert sh == SH_NUMBERS * num_samples, sh
    assert nrf == FIELD_NUMBERS * num_samples + FIELD_SHARED, nrf
    assert PAPER_COUNTS.get(num_samples, (sh, nrf)) == (sh, nrf), (sh, nrf)
    # A field, fixed in size as the paper has it, and six lobes fit only if there are samples enough to share it.
    for label, spec in specs.items():
        if label not in OVER_BUDGET and spec.kind != "field":
            assert spec.build().count(num_samples) <= sh, label


def rate_cells(setup: Setup, label: str, spec: ModelSpec, fit: FitConfig, targets: dict[str, Any]) -> list[Cell]:
    """Fits that differ in their learning rates only."""
    rates = RATES if spec.build().num_shared() else SAMPLE_RATES
    return [
        Cell(
            f"{setup}-rate-{label}-{sample:g}-{shared:g}",
            "rate",
            setup,
            label,
            RATE_SEED,
            spec,
            replace(fit, sample_lr=sample, shared_lr=shared),
            targets,
        )
        for sample, shared in rates
    ]


def main_cell(setup: Setup, label: str, spec: ModelSpec, fit: FitConfig, seed: int) -> Cell:
    """One seed of one row of the table."""
    return Cell(f"{setup}-{label}-seed{seed}", "main", setup, label, seed, spec, fit)


def reference_cells(setup: Setup, seed: int) -> list[Cell]:
    """Least squares, and the bound of linear codes: nothing iterates."""
    return [
        Cell(f"{setup}-sh-lsq-seed{seed}", "main", setup, "sh-lsq", seed, ModelSpec("harmonics"), None),
        Cell(f"{setup}-linear-seed{seed}", "main", setup, "linear", seed, None, None),
    ]


def variation_cells(setup: Setup, spec: ModelSpec, fit: FitConfig, seed: int, size: dict[str, int]) -> list[Cell]:
    """The guesses about what differs from the paper: one thing at a time, first in the fit, then in the targets.

    Args:
        setup, spec, fit, seed: what is varied.
        size: arguments of all targets: the image is a smaller one.
    """

    def vary(what: str, spec: ModelSpec | None, fit: FitConfig | None, **targets: Any) -> Cell:
        return Cell(f"{setup}-vary-{what}-seed{seed}", "vary", setup, what, seed, spec, fit, {**size, **targets})

    more = replace(fit, passes=4 * fit.passes)
    cells = [
        vary("nrf-four-times-passes", spec, more),
        vary("nrf-quarter-passes", spec, replace(fit, passes=max(fit.passes // 4, 1))),
        vary("nrf-method-rates", spec, replace(fit, sample_lr=0.0025, shared_lr=0.001)),
        vary("nrf-zero-output", spec.but(zero_output=True), fit),
        vary("nrf-wide-latents", spec.but(latent_std=1.0), fit),
    ]
    if setup != "image":
        cells.append(vary("nrf-whole-batch", spec, replace(fit, block=10**6)))
    for what, targets in TARGET_CHANGES[setup].items():
        cells.append(vary(f"sh-lsq-{what}", ModelSpec("harmonics"), None, **targets))
        cells.append(vary(f"linear-{what}", None, None, **targets))
        cells.append(vary(f"nrf-{what}", spec, fit, **targets))
        if what in LOW_DIMENSIONAL:
            cells.append(vary(f"nrf-more-{what}", spec, more, **targets))
    return cells


def sweep_cells(setup: Setup, spec: ModelSpec, fit: FitConfig, seed: int) -> list[Cell]:
    """Sizes of the field, one at a time, and degrees of the harmonics."""

    def cell(key: str, size: int, spec: ModelSpec, fit: FitConfig | None) -> Cell:
        return Cell(f"{setup}-sweep-{key}-{size}-seed{seed}", "sweep", setup, key, seed, spec, fit)

    sizes = [("latent_dim", size) for size in (4, 8, 16)]
    sizes += [("width", size) for size in (16, 32, 128)] + [("bands", size) for size in (1, 2, 3, 5, 6)]
    cells = [cell(key, size, spec.but(**{key: size}), fit) for key, size in sizes]
    return cells + [cell("degree", degree, ModelSpec("harmonics", {"degree": degree}), None) for degree in range(6)]
