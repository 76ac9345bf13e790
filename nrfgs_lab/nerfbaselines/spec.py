# SPDX-License-Identifier: Apache-2.0
"""Registers the methods with nerfbaselines, which reads this file by the entry point `nerfbaselines.specs`, or by
NERFBASELINES_REGISTER. Nothing heavy is imported.

The methods run in the environment that they are installed in (`--backend python`).
"""

from nerfbaselines import register

METHODS = {
    "nrfgs": ("NRF-GS", "A neural residual field adds what depends on the view to base colour and opacity."),
    "nrfgs-fast": ("NRF-GS fast", "NRF-GS in 10,000 steps, its schedules shortened to them."),
    "nrfgs-best": ("NRF-GS best", "NRF-GS with more splats."),
    "nrfgs-sh": ("NRF-GS host with SH", "The same host with spherical harmonics of degree 3, as in 3DGS."),
    "nrfgs-harmonics": ("NRF-GS's rules with SH", "NRF-GS with spherical harmonics instead of the field."),
    "nrfgs-vdgs": ("NRF-GS host with VDGS", "The same host; opacity depends on the view as in VDGS."),
    "nrfgs-gsnb": ("NRF-GS host with GSNB", "The same host; directions have a learnt basis as in GSNB."),
    "nrfgs-sg": ("NRF-GS host with SG", "The same host with three spherical Gaussians per splat."),
}
"""Method -> its name and a description."""
LICENSE = {"name": "Apache 2.0", "url": "https://www.apache.org/licenses/LICENSE-2.0"}

for _method, (_name, _description) in METHODS.items():
    register(
        {
            "id": _method,
            "method_class": f"nrfgs_lab.nerfbaselines.method:{_method.title().replace('-', '')}",
            "backends_order": ["python"],
            "metadata": {"name": _name, "description": _description, "licenses": [LICENSE]},
        }
    )
