# SPDX-License-Identifier: Apache-2.0
"""Speed of a page of `nrfgs export web` in a browser, and PSNR of its pictures against the model's.

    python -m nrfgs_lab.pages.web PAGE.html RECORD.json --browser "chromium --headless=new ..." --config CONFIG

Any browser that takes an address will do. It opens a page from a local server that holds PAGE in a frame, measures, and
sends back numbers and three pictures. Without --config only Python's own library is needed. On an H200 it was
"chromium-headless-shell --no-sandbox --enable-gpu --ignore-gpu-blocklist --use-gl=angle --use-angle=gl-egl", or
"... vulkan --enable-features=Vulkan --disable-vulkan-surface"; Firefox without a screen: "xvfb-run -a firefox-esr".
"""

import argparse
import base64
import http.server
import json
import os
import shlex
import signal
import subprocess
import tempfile
import threading
from pathlib import Path

SOFTWARE = "chromium --headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader"
"""Without a GPU."""
PICTURES, PATIENCE = 3, 300
"""Pictures that are compared, and seconds to wait for an answer."""

OUTER = """<!DOCTYPE html><body style="margin:0"><script>
const send = (answer) => fetch("done", { method: "POST", body: JSON.stringify(answer) });
const frame = document.createElement("iframe"), start = performance.now();
Object.assign(frame, { src: "page.html", width: WIDTH, height: HEIGHT, style: "border:0" });
frame.onload = async () => {
  const page = frame.contentWindow.nrfgs;
  try {
    await page.ready;
    const loaded = (performance.now() - start) / 1000;
    const count = frame.contentDocument.getElementById("photograph").length;
    const pictures = [];
    for (let k = 0; k < PICTURES; k++) {
      page.visit(Math.floor((k * count) / PICTURES));
      await page.finished();
      pictures.push(page.picture());
    }
    await send({ seconds_to_load: loaded, ...(await page.measure(COUNT)), pictures });
  } catch (error) {
    await send({ failed: `${error} ${frame.contentDocument.getElementById("failed").textContent}` });
  }
};
document.body.append(frame);
</script>"""


def measured(page: Path, browser: list[str], size: tuple[int, int], count: int) -> dict:
    """`nrfgs.measure`'s answer, "seconds_to_load", and "pictures": PNG bytes from some photographs' cameras.

    Args:
        page: the .html file, or the folder of a page with a separate scene.
        browser: command and options; a profile's folder and the address are added.
        size: of the frame, in CSS pixels.
        count: pictures over which seconds are averaged.

    Raises:
        RuntimeError: there is no answer, or the page failed.
    """
    folder, name = (page, "index.html") if page.is_dir() else (page.parent, page.name)
    outer = OUTER.replace("WIDTH", str(size[0])).replace("HEIGHT", str(size[1])).replace("COUNT", str(count))
    outer = outer.replace("PICTURES", str(PICTURES))
    answers: list[dict] = []
    there = threading.Event()

    class Host(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args):
            super().__init__(*args, directory=str(folder))

        def log_message(self, *_):
            pass

        def do_GET(self):
            if self.path == "/page.html":
                self.path = "/" + name
            if self.path != "/outer":
                return super().do_GET()
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(outer.encode())

        def do_POST(self):
            answers.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()
            there.set()

    with (
        http.server.ThreadingHTTPServer(("127.0.0.1", 0), Host) as server,
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
    ):
        threading.Thread(target=server.serve_forever, daemon=True).start()
        firefox = any("firefox" in word for word in browser)
        own = ["--profile", profile, "--no-remote"] if firefox else [f"--user-data-dir={profile}"]
        if firefox:  # without a GPU it refuses WebGL
            Path(profile, "user.js").write_text('user_pref("webgl.force-enabled", true);')
        command = [*browser, *own, f"http://127.0.0.1:{server.server_port}/outer"]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
        try:
            there.wait(PATIENCE)
        finally:
            os.killpg(process.pid, signal.SIGTERM)  # with the browser's children
            process.wait()
            server.shutdown()
    if not answers or "failed" in answers[0]:
        raise RuntimeError(answers[0]["failed"] if answers else f"no answer within {PATIENCE} seconds")
    answer = answers[0]
    answer["pictures"] = [base64.b64decode(picture.split(",")[1]) for picture in answer["pictures"]]
    return answer


def alike(page: Path, config: Path, browser: list[str]) -> list[float]:
    """PSNR, dB, of a page's pictures against a model's, the training's or the one from `nrfgs export compact`."""
    import io

    import numpy as np
    import torch
    from PIL import Image

    from nrfgs_ns.image.metrics import psnr
    from nrfgs_ns.trained.loading import load_model

    pipeline = load_model(config, "test")
    cameras = pipeline.datamanager.train_dataset.cameras
    if not len(cameras):
        raise RuntimeError(f"{config}: no training views")
    size = int(cameras.width[0]), int(cameras.height[0])
    scores = []
    for k, picture in enumerate(measured(page, browser, size, 1)["pictures"]):
        place = k * len(cameras) // PICTURES
        pixels = torch.from_numpy(np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")) / np.float32(255))
        expected = pipeline.model.get_outputs_for_camera(cameras[place : place + 1])["rgb"].cpu()
        scores.append(psnr(pixels, expected))
    return scores


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("page", type=Path, help="page of nrfgs export web")
    parser.add_argument("record", type=Path, help="JSON to write; the pictures go beside it")
    parser.add_argument("--browser", default=SOFTWARE, help="command that opens an address")
    parser.add_argument("--config", type=Path, help="compare the page's pictures with those of this model")
    parser.add_argument("--size", type=int, nargs=2, default=(1920, 1080), help="width and height, pixels")
    parser.add_argument("--count", type=int, default=50, help="pictures over which seconds are averaged")
    options = parser.parse_args()
    browser = shlex.split(options.browser)
    record = measured(options.page, browser, options.size, options.count)
    options.record.parent.mkdir(parents=True, exist_ok=True)
    for k, picture in enumerate(record.pop("pictures")):
        options.record.with_name(f"{options.record.stem}-{k}.png").write_bytes(picture)
    files = [options.page] if options.page.is_file() else list(options.page.iterdir())
    record["bytes"] = sum(file.stat().st_size for file in files)
    if options.config:
        record["psnr"] = alike(options.page, options.config, browser)
    options.record.write_text(json.dumps(record, indent=1) + "\n")
    print(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
