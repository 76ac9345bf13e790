# SPDX-License-Identifier: Apache-2.0
# The made scene as SOG (version 2), as splat-transform writes it but for its palette, which is drawn, not clustered.
import io, json, sys, zipfile, math
from pathlib import Path
import numpy as np
from PIL import Image
sys.path.insert(0, str(Path(__file__).parent))
import scene
folder, count = Path(sys.argv[1]), int(sys.argv[2])
s, draw = scene.splats(count), np.random.default_rng(1)
x, y, z = s["means"].T
w, a, b, c = s["quats"].T
means = np.stack([x, -z, y], 1)
quats = np.stack([w - a, a + w, b - c, c + b], 1) * 0.5**0.5
# Morton order, so that neighbours in the pictures are neighbours in space
cells = ((means - means.min(0)) / np.ptp(means, axis=0).max() * 1023).astype(np.uint64)
key = np.zeros(count, np.uint64)
for bit in range(10):
    for axis in range(3):
        key |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
order = np.argsort(key, kind="stable")
means, quats, scales = means[order], quats[order], s["scales"][order]
colors, opacity = s["features_dc"][order], 1 / (1 + np.exp(-s["opacities"][order, 0]))
width = math.ceil(math.sqrt(count) / 4) * 4
height = math.ceil(count / width / 4) * 4

def webp(values, shape=None):
    h, w = shape or (height, width)
    pixels = np.full((h * w, 4), 255, np.uint8)
    pixels[: len(values), : values.shape[1]] = values
    stream = io.BytesIO()
    Image.fromarray(pixels.reshape(h, w, 4)).save(stream, "webp", lossless=True, quality=50, method=3, exact=True)
    return stream.getvalue()

def indexed(values):
    book = np.quantile(values, (np.arange(256) + 0.5) / 256).astype(np.float32)
    edges = (book[1:] + book[:-1]) / 2
    return book.tolist(), np.searchsorted(edges, values).astype(np.uint8)

logs = np.sign(means) * np.log1p(np.abs(means))
low, high = logs.min(0), logs.max(0)
codes = np.round((logs - low) / (high - low) * 65535).astype(np.uint16)
largest = np.abs(quats).argmax(1)
quats *= np.sign(quats[np.arange(count), largest])[:, None]
rest = np.stack([np.delete(np.arange(4), k) for k in range(4)])[largest]
small = np.take_along_axis(quats, rest, 1)
packed = np.concatenate([np.round((small / 2**0.5 + 0.5) * 255).clip(0, 255), 252 + largest[:, None]], 1)
scale_book, scale_codes = indexed(scales)
color_book, color_codes = indexed(colors)
palette = min(64, 2 ** int(math.log2(max(count / 1024, 1)))) * 1024 if count >= 1024 else 1024  # splat-transform's
drawn = 0.05 * draw.standard_normal((palette, 15, 3), dtype=np.float32)
rest_book, rest_codes = indexed(drawn)
labels = draw.integers(palette, size=count)
files = {
    "means_l.webp": webp((codes & 255).astype(np.uint8)), "means_u.webp": webp((codes >> 8).astype(np.uint8)),
    "quats.webp": webp(packed), "scales.webp": webp(scale_codes),
    "sh0.webp": webp(np.concatenate([color_codes, np.round(255 * opacity)[:, None]], 1)),
    "shN_centroids.webp": webp(rest_codes.reshape(-1, 3), (palette // 64, 960)),
    "shN_labels.webp": webp(np.stack([labels & 255, labels >> 8, 0 * labels], 1)),
}
meta = {
    "version": 2, "asset": {"generator": "made"}, "count": count, "antialias": False,
    "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
    "scales": {"codebook": scale_book, "files": ["scales.webp"]}, "quats": {"files": ["quats.webp"]},
    "sh0": {"codebook": color_book, "files": ["sh0.webp"]},
    "shN": {"count": palette, "bands": 3, "codebook": rest_book, "files": ["shN_centroids.webp", "shN_labels.webp"]},
}
with zipfile.ZipFile(folder / "scene.sog", "w", zipfile.ZIP_STORED) as archive:
    archive.writestr("meta.json", json.dumps(meta))
    for name, data in files.items():
        archive.writestr(name, data)
scene.write_cameras(folder)
print(count, palette, {k: len(v) for k, v in files.items()}, (folder / "scene.sog").stat().st_size)
