# SPDX-License-Identifier: Apache-2.0
"""From a model's configuration to its strategy of densification."""

from typing import Any

from nrfgs_ns.densification.gradient import GradientDensification, OriginalDensification, PruneBySeenOpacity
from nrfgs_ns.densification.mcmc import Mcmc
from nrfgs_ns.densification.strategy import Densification
from nrfgs_ns.errors import InputError

LARGEST_BUDGET = 2**24
"""`torch.multinomial` draws from no more categories than this."""
SPLATFACTOS_THRESHOLDS = (
    "cull_alpha_thresh",
    "densify_grad_thresh",
    "densify_size_thresh",
    "cull_scale_thresh",
    "use_absgrad",
    "cull_screen_size",
    "split_screen_size",
    "stop_screen_size_at",
)
"""Options of the model that only the strategy `splatfacto` reads."""
READ_BY = {"original": "original", "mcmc": "mcmc", "splat_budget": "mcmc"}
"""Options of the model that one of the others alone reads -> which."""
UNREAD = {
    "splatfacto": ("original", "mcmc", "splat_budget"),
    "original": (*SPLATFACTOS_THRESHOLDS, "mcmc", "splat_budget"),
    "mcmc": (*SPLATFACTOS_THRESHOLDS, "reset_alpha_every", "stop_split_at", "keep", "original"),
}
"""Options of the model that a strategy does not read, and refuses where they are set."""


def build_densification(config: Any, num_train_images: int, scene_unit: float = 1.0) -> Densification:
    """The strategy that a model's configuration asks for.

    Args:
        config: an NrfgsModelConfig.
        num_train_images: splatfacto waits for as many steps after a reset.
        scene_unit: world units in a scene unit, in which the configuration's sizes are.

    Raises:
        InputError: an option is out of range, or belongs to another strategy.
    """
    makers = {"splatfacto": _splatfacto, "original": _original, "mcmc": _mcmc}
    if config.densification not in makers:
        raise InputError(
            f"pipeline.model.densification is {config.densification!r}; use one of {', '.join(map(repr, makers))}."
        )
    if config.opacity_seen_by_densification not in (None, "base", "peak"):
        raise InputError(
            f"pipeline.model.opacity_seen_by_densification is {config.opacity_seen_by_densification!r}; "
            "use 'base' or 'peak'."
        )
    if not 0 < config.keep <= 1:
        raise InputError(f"pipeline.model.keep is {config.keep}; it must be above 0 and at most 1.")
    _refuse_options(config)
    return makers[config.densification](config, num_train_images, scene_unit)


def _splatfacto(config: Any, num_train_images: int, scene_unit: float) -> Densification:
    thresholds = {
        "prune_opa": config.cull_alpha_thresh,
        "grow_grad2d": config.densify_grad_thresh,
        "grow_scale3d": config.densify_size_thresh,
        "grow_scale2d": config.split_screen_size,
        "prune_scale3d": config.cull_scale_thresh,
        "prune_scale2d": config.cull_screen_size,
        "refine_scale2d_stop_iter": config.stop_screen_size_at,
        "pause_refine_after_reset": num_train_images + config.refine_every,
        "absgrad": config.use_absgrad,
    }
    return _by_gradients(config, thresholds, scene_unit, reset_at_start=True)


def _original(config: Any, num_train_images: int, scene_unit: float) -> Densification:
    rules: OriginalDensification = config.original
    thresholds = {
        "prune_opa": rules.prune_opacity,
        "grow_grad2d": rules.grow_gradient,
        "grow_scale3d": rules.grow_scale,
        "prune_scale3d": rules.prune_scale,
        "refine_scale2d_stop_iter": 0,
        "pause_refine_after_reset": 0,
        "absgrad": False,
    }
    return _by_gradients(config, thresholds, None, reset_at_start=False)


def _by_gradients(config: Any, thresholds: dict[str, Any], scene_unit: float | None, reset_at_start: bool):
    """Gsplat's strategy with these thresholds, on the schedule that all models have."""
    strategy = PruneBySeenOpacity(
        refine_start_iter=config.warmup_length,
        refine_stop_iter=config.stop_split_at,
        refine_every=config.refine_every,
        reset_every=config.reset_alpha_every * config.refine_every,
        verbose=True,
        **thresholds,
    )
    seen = config.opacity_seen_by_densification or "base"
    return GradientDensification(config.densification, strategy, seen, scene_unit, reset_at_start, config.keep)


def _mcmc(config: Any, num_train_images: int, scene_unit: float) -> Densification:
    if not 1 <= config.splat_budget <= LARGEST_BUDGET:
        raise InputError(
            f"pipeline.model.splat_budget is {config.splat_budget}; it must lie between 1 and {LARGEST_BUDGET}."
        )
    return Mcmc(
        config.mcmc,
        budget=config.splat_budget,
        start=config.warmup_length,
        every=config.refine_every,
        opacity_seen=config.opacity_seen_by_densification or "peak",
        scene_unit=scene_unit,
    )


def _refuse_options(config: Any) -> None:
    """Raise InputError where an option was set that this strategy does not read: it would be ignored silently."""
    strategy, default = config.densification, type(config)()
    for name in UNREAD[strategy]:
        if getattr(config, name) != getattr(default, name):
            reader = READ_BY.get(name)
            raise InputError(
                f"pipeline.model.{name} has no effect with the densification {strategy!r}. Leave it out, or use "
                + (
                    f"--pipeline.model.densification {reader}."
                    if reader
                    else f"--pipeline.model.{strategy}.... (see ns-train METHOD --help)."
                )
            )
