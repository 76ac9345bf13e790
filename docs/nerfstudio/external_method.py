# SPDX-License-Identifier: Apache-2.0
"""The entry for nerfstudio/configs/external_methods.py: one of four parts of a pull request that lists this method.

1. This entry. The wheel must be on the package index first, under the name below.
2. nrfgs.md, as docs/nerfology/methods/nrfgs.md, without the comments around its table.
3. In docs/nerfology/methods/index.md, in the list of methods: NRF-GS<nrfgs.md>
4. In docs/index.md, under third-party methods:
   - [NRF-GS](nerfology/methods/nrfgs.md): Gaussian splatting with a neural residual field
"""

from nerfstudio.configs.external_methods import ExternalMethod, external_methods

# NRF-GS
external_methods.append(
    ExternalMethod(
        """[bold yellow]NRF-GS[/bold yellow]
For more information visit: https://docs.nerf.studio/nerfology/methods/nrfgs.html

To enable NRF-GS, you must install it first by running:
  [grey]pip install nrfgs-ns[/grey]""",
        configurations=[
            ("nrfgs", "NRF-GS, neural residual field for view-dependent colour and opacity"),
            ("nrfgs-fast", "NRF-GS in a third of the steps"),
            ("nrfgs-best", "NRF-GS with more splats and detail"),
        ],
        pip_package="nrfgs-ns",
    )
)
