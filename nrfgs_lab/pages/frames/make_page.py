# SPDX-License-Identifier: Apache-2.0
# The page of a made scene, by this project's encoder and page.
import io, json, sys, math
from pathlib import Path
import numpy as np, torch
from PIL import Image
sys.path.insert(0, str(Path(__file__).parent))
import scene
from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.compact.encode import encode
from nrfgs_ns.compact.format import container
from nrfgs_ns.export.web.page import page
out, count = Path(sys.argv[1]), int(sys.argv[2])
torch.manual_seed(0)
s = {k: torch.from_numpy(v) for k, v in scene.splats(count).items()}
head = NrfConfig(output_init="default").setup().requires_grad_(False)
field = Field(head, s | {"latents": torch.randn(count, head.config.latent_dim)})
blob = container(*encode(field, {"rasterize_mode": "classic", "background": [0.0] * 3}))
eye = scene.eyes()[0]
size = scene.SIZE
distance, focal, right = math.hypot(*eye), scene.FOCAL * size[0], torch.tensor([0.0, 1.0, 0.0])
back = torch.tensor(eye) / distance
pose = torch.stack([right, torch.linalg.cross(back, right), back, distance * back], dim=1).flatten().tolist()
photograph = {"name": "0", "pose": pose, "lens": [focal, focal, size[0] / 2, size[1] / 2], "size": list(size)}
about = {"photographs": [photograph | {"distance": distance}], "start": 0, "up": [0, 0, 1]}
Image.new("RGB", (1, 1)).save(poster := io.BytesIO(), "jpeg")
out.mkdir(parents=True, exist_ok=True)
(out / "scene.nrf").write_bytes(blob)
(out / "page.html").write_text(page(about, poster.getvalue(), "scene.nrf", "Discs"))
print(count, len(blob), head.config.latent_dim)
