# SPDX-License-Identifier: Apache-2.0
"""Frames per second of this project's page, SuperSplat's viewer and Spark, in one Chromium on this machine's GPU.

    frames.py FOLDER OUT    FOLDER: chromium.tar.xz.*, www.tar.*, gl/*.deb, drive.js

Alike for all: the camera goes 0.02 radians around the scene in each frame that requestAnimationFrame gives, without
vsync and limit of the rate; frames by seconds until readPixels returns after the last. Standard library only.
"""

import base64
import fcntl
import functools
import glob
import http.server
import io
import json
import lzma
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import tarfile
import threading
import time
from pathlib import Path

BEGIN = time.monotonic()
BUDGET = float(os.environ.get("BUDGET", 200))  # seconds in all
SIZES = [int(n) for n in os.environ.get("SIZES", "250000 1000000").split()]
WIDTH, HEIGHT = map(int, os.environ.get("WINDOW", "1920x1080").split("x"))
FRAMES, WARM = int(os.environ.get("FRAMES", 100)), int(os.environ.get("WARM", 20))
ALLOW_SOFTWARE = os.environ.get("SOFTWARE", "1") == "1"  # as the last way
KIND = os.environ.get("KIND", "sog")  # or ply, made there
FIRST, REST = ("page", "supersplat", "spark"), ("webgpu", "auto", "base")
VIEWERS = {name: "{count}/page.html" for name in ("page", "base", "auto")} | {
    "supersplat": "supersplat/index.html?webgl&noui&settings=../{count}/settings.json&content=../{count}/scene.{kind}",
    "webgpu": "supersplat/index.html?noui&settings=../{count}/settings.json&content=../{count}/scene.{kind}",
    "spark": "spark.html?cameras={count}/cameras.json&content={count}/scene.{kind}",
}
COMMON = [
    "--no-sandbox", "--disable-gpu-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars", "--mute-audio",
    "--force-device-scale-factor=1", "--remote-debugging-pipe", "--no-first-run", "--disable-extensions",
    "--disable-background-timer-throttling", "--disable-renderer-backgrounding", "--enable-logging=stderr",
    "--disable-backgrounding-occluded-windows", "--disable-gpu-vsync", "--disable-frame-rate-limit",
    "--ignore-gpu-blocklist", "--enable-gpu", "--enable-unsafe-webgpu", "--disable-gpu-process-crash-limit",
    "--use-gl=angle",
]  # fmt: skip
BACKENDS = {
    "vulkan": ["--use-angle=vulkan", "--enable-features=Vulkan", "--disable-vulkan-surface"],
    "gl-egl": ["--use-angle=gl-egl"],
    "gl-egl, Vulkan": ["--use-angle=gl-egl", "--enable-features=Vulkan", "--disable-vulkan-surface"],
    "gl": ["--use-angle=gl"],
    "default": [],
}
SOFTWARE = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
# Mean rate of requestAnimationFrame with a canvas that is cleared: what the browser itself can do here.
PROBE = """<!DOCTYPE html><style>body{margin:0}</style><canvas id=c></canvas><script>
c.width = innerWidth; c.height = innerHeight;
const gl = c.getContext("webgl2", {powerPreference: "high-performance"});
window.probe = async () => {
  if (!gl) return {renderer: null};
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const renderer = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  const tick = () => new Promise((done) => requestAnimationFrame(done)), byte = new Uint8Array(4);
  for (let i = 0; i < 20; i++) await tick();
  let n = 0; const start = performance.now();
  while (performance.now() - start < 700) { gl.clearColor(n % 2, 0, 0, 1); gl.clear(gl.COLOR_BUFFER_BIT); await tick(); n++; }
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, byte);
  const raf_hz = 1000 * n / (performance.now() - start);
  let webgpu = null;
  if (navigator.gpu) {
    const a = await Promise.race([navigator.gpu.requestAdapter().catch((e) => null), new Promise((d) => setTimeout(d, 3000, null))]);
    if (a) webgpu = `${a.info.vendor} ${a.info.architecture} ${a.info.description}`;
  }
  return {renderer, raf_hz, webgpu, size: [c.width, c.height], ratio: devicePixelRatio, texture: gl.getParameter(gl.MAX_TEXTURE_SIZE)};
};
</script>"""

# What drive.js asks of the page's module; fix() keeps the quality that follows the frames' time from doing so.
OPENED = """
const paced = keepPace;
window.internals = {
  painter: () => painter,
  state: () => ({ seconds_to_sort: sortTook, scale, share: Math.min(1, share / painter.rows), drawn: painter.drawn }),
  fix() { keepPace = () => {}; share = Infinity; scale = 1; },
  free() { keepPace = paced; },
};
"""

folder, out = Path(sys.argv[1]), Path(sys.argv[2])
root = folder / "root"
record = {"machine": {}, "tries": [], "records": []}


def left() -> float:
    return BUDGET - (time.monotonic() - BEGIN)


def save() -> None:
    record["seconds"] = round(time.monotonic() - BEGIN, 1)
    (out / "frames.json.new").write_text(json.dumps(record, indent=1))
    os.replace(out / "frames.json.new", out / "frames.json")


def log(*words: object) -> None:
    line = f"[{time.monotonic() - BEGIN:6.1f}] " + " ".join(map(str, words))
    print(line, flush=True)
    with open(out / "frames.log", "a") as file:
        file.write(line + "\n")


def said(*command: str, timeout: float = 10, **options) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=timeout, **options)
        return (done.stdout + done.stderr).strip()
    except Exception as error:
        return f"{type(error).__name__}: {error}"


class Joined(io.RawIOBase):
    """Files one after the other."""

    def __init__(self, paths):
        self.paths, self.file = list(paths), None

    def readable(self):
        return True

    def readinto(self, buffer):
        while True:
            if self.file is None:
                if not self.paths:
                    return 0
                self.file = open(self.paths.pop(0), "rb")
            if count := self.file.readinto(buffer):
                return count
            self.file.close()
            self.file = None


def unpack(name: str, target: Path) -> None:
    parts = sorted(glob.glob(f"{folder}/{name}.tar.xz.*"))
    if not parts:
        log(f"no parts of {name}")
        return
    with lzma.open(io.BufferedReader(Joined(parts))) as stream, tarfile.open(fileobj=stream, mode="r|") as archive:
        archive.extractall(target, filter="fully_trusted")
    log(f"unpacked {name}: {len(parts)} parts")


# ---- libraries

DRIVER = ["/usr/local/nvidia/lib64", "/usr/local/nvidia/lib"]
shell = root / "chrome" / "shell"


def environment(where: str) -> tuple[dict[str, str], list[str]]:
    """The browser's environment, and what comes before its path on the command line."""
    env = {key: value for key, value in os.environ.items() if not key.startswith(("LD_", "DISPLAY", "DBUS"))}
    use, driver = [str(root / "use")], [path for path in DRIVER if Path(path).is_dir()]
    command = [str(shell)]
    if where == "all carried":
        use = [str(root / "lib"), str(root / "lib-cpp")]
    if where == "own libc":
        use = [str(root / name) for name in ("lib", "lib-cpp", "glibc")]
        driver += ["/usr/lib/x86_64-linux-gnu", "/usr/lib64"]
        command = [str(shell.parent / "ld-linux-x86-64.so.2"), "--library-path", ":".join(use + driver), str(shell)]
    env["LD_LIBRARY_PATH"] = ":".join([*use, *driver, str(root / "chrome")])  # the last for its libvulkan.so.1
    if where == "own libc":
        del env["LD_LIBRARY_PATH"]  # the system's shell starts the browser's processes
    env["FONTCONFIG_FILE"] = str(root / "fonts/fonts.conf")
    env["HOME"] = str(folder / "home")
    env["XDG_RUNTIME_DIR"] = env["TMPDIR"] = str(folder / "tmp")
    icds = [f for f in glob.glob("/usr/local/nvidia/share/vulkan/icd.d/nvidia_icd*.json")]
    vendors = [f for f in glob.glob("/usr/local/nvidia/share/glvnd/egl_vendor.d/*nvidia*.json")]
    if icds:
        env["VK_DRIVER_FILES"] = env["VK_ICD_FILENAMES"] = icds[0]
    if vendors:
        env["__EGL_VENDOR_LIBRARY_FILENAMES"] = vendors[0]
    return env, command


def set_up() -> str:
    """Which libraries to use: the first way in which the browser starts."""
    for name in ("home", "tmp", "root/use"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    known = said("ldconfig", "-p")
    record["machine"] |= {
        "system": said("sh", "-c", ". /etc/os-release; echo $PRETTY_NAME; ldd --version | head -1; uname -r; nproc; free -m | sed -n 2p; df -m /dev/shm | tail -1"),
        "gpu": said("nvidia-smi", "--query-gpu=name,driver_version,memory.used", "--format=csv,noheader"),
        "cpu": said("sh", "-c", "grep -m1 'model name' /proc/cpuinfo"),
    }
    debs = glob.glob(f"{folder}/gl/*.deb")
    if debs and not ("libvulkan.so.1" in known and "libEGL.so.1" in known):
        for deb in debs:
            log(Path(deb).name, said("dpkg", "-x", deb, "/") if os.environ.get("DEBS", "1") == "1" else "left")
        said("ldconfig")
        known = said("ldconfig", "-p")
    record["machine"]["loaders"] = [line.strip() for line in known.splitlines() if re.search("libvulkan|libEGL|libGLX_nv|glvnd|nvidia-glcore", line)][:20]
    record["machine"]["icds"] = said("sh", "-c", "ls /usr/local/nvidia/share/vulkan/icd.d /usr/share/vulkan/icd.d /etc/vulkan/icd.d /usr/share/glvnd/egl_vendor.d /usr/local/nvidia/share/glvnd/egl_vendor.d /dev/nvidia* /dev/dri 2>&1")
    log(json.dumps(record["machine"], indent=1))
    present = set(re.findall(r"^\s*(\S+) \(libc6,x86-64", known, flags=re.M))
    carried = 0
    (root / "lib-cpp").mkdir(exist_ok=True)
    shutil.copy(root / "glibc/ld-linux-x86-64.so.2", shell.parent)  # beside the browser's files, which it seeks there
    for name in ("libstdc++.so.6", "libgcc_s.so.1"):
        shutil.copy(root / "glibc" / name, root / "lib-cpp" / name)
    for path in [*(root / "lib").iterdir(), *(root / "lib-cpp").iterdir()]:
        link = root / "use" / path.name
        if path.name not in present and not link.exists():
            shutil.copy(path, link)
            carried += 1
    log(f"{carried} libraries carried, the others are the system's")
    (folder / "shell.sh").write_text(f'#!/bin/sh\nexec {" ".join(environment("own libc")[1])} "$@"\n')
    (folder / "shell.sh").chmod(0o755)
    for where in os.environ.get("WHERE", "missing carried,all carried,own libc").split(","):
        env, command = environment(where)
        answer = said(*command, "--version", env=env, timeout=20)
        log(where, ":", answer[-300:])
        record["machine"].setdefault("starts", {})[where] = answer[-300:]
        if re.search(r"(Chrom\w+|Headless\w*) [\d.]+", answer):
            try:
                browser = Browser(where, SOFTWARE, "start")
                log("starts:", browser.version, browser.evaluate("6 * 7"))
                browser.close()
                return where
            except Exception as error:
                log(f"does not start: {type(error).__name__}: {error}", (folder / "tmp/start.err").read_text(errors="replace")[-1500:])
        lacking = [line.strip() for line in said("ldd", str(shell), env=env).splitlines() if "not found" in line]
        log("lacking:", lacking[:20])
    raise SystemExit("the browser does not start")


# ---- the browser

class Browser:
    """A headless Chromium, driven through a pair of pipes."""

    def __init__(self, where: str, flags: list[str], name: str):
        self.number, self.buffer, self.events = 0, b"", []
        profile = folder / "tmp" / f"profile-{time.monotonic_ns()}"
        env, command = environment(where)
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD, 20) for end in (*os.pipe(), *os.pipe())]
        to_read, self.write_end, self.read_end, to_write = ends
        if where == "own libc":
            command += [f"--browser-subprocess-path={folder}/shell.sh", "--no-zygote"]
        command += [*COMMON, *flags, f"--user-data-dir={profile}", f"--window-size={WIDTH},{HEIGHT}", "about:blank"]

        def child():
            os.dup2(to_read, 3)
            os.dup2(to_write, 4)

        self.errors = folder / "tmp" / f"{re.sub('[^a-z0-9]', '-', name)}.err"
        with open(self.errors, "wb") as errors:
            self.process = subprocess.Popen(
                command, env=env, preexec_fn=child, pass_fds=(3, 4), stdin=subprocess.DEVNULL, stdout=errors,
                stderr=errors, start_new_session=True,
            )  # fmt: skip
        os.close(to_read)
        os.close(to_write)
        self.session = None
        try:
            self.version = self.call("Browser.getVersion", limit=25)["product"]
            target = self.call("Target.createTarget", url="about:blank", width=WIDTH, height=HEIGHT)["targetId"]
            self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            for domain in ("Page", "Runtime", "Performance", "Log"):
                self.call(f"{domain}.enable")
            self.call("Emulation.setDeviceMetricsOverride", width=WIDTH, height=HEIGHT, deviceScaleFactor=1, mobile=False)
        except Exception:
            self.close()
            raise

    def call(self, method: str, limit: float = 20, **values):
        self.number += 1
        message = {"id": self.number, "method": method, "params": values}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.write_end, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + limit
        while True:
            answer = self.next(until, method)
            if answer.get("id") == self.number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            if answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled", "Inspector.targetCrashed"):
                self.events.append(json.dumps(answer)[:600])

    def next(self, until: float, what: str):
        while b"\0" not in self.buffer:
            wait = until - time.monotonic()
            if wait <= 0 or not select.select([self.read_end], [], [], wait)[0]:
                raise TimeoutError(f"no answer to {what}")
            part = os.read(self.read_end, 1 << 20)
            if not part:
                raise EOFError(f"the browser ended at {what}")
            self.buffer += part
        message, _, self.buffer = self.buffer.partition(b"\0")
        return json.loads(message)

    def evaluate(self, expression: str, limit: float = 30):
        answer = self.call("Runtime.evaluate", limit, expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(json.dumps(answer["exceptionDetails"])[:600])
        return answer["result"].get("value")

    def processes(self) -> dict[str, list[dict[str, int]]]:
        """Memory of the browser's processes, MB, by their kind."""
        kinds = {}
        for path in glob.glob("/proc/[0-9]*"):
            try:
                words = Path(path, "cmdline").read_bytes().decode(errors="replace")
                if os.getpgid(int(path[6:])) != self.process.pid:
                    continue
                status = dict(re.findall(r"(VmRSS|VmHWM):\s+(\d+)", Path(path, "status").read_text()))
            except (OSError, ValueError):
                continue
            kind = (re.findall(r"--type=([\w-]+)", words) or ["browser"])[0]
            if status:
                kinds.setdefault(kind, []).append({"mb": int(status["VmRSS"]) // 1024, "peak": int(status["VmHWM"]) // 1024})
        return kinds

    def tail(self, size: int = 1500) -> str:
        return self.errors.read_bytes()[-size:].decode(errors="replace")

    def close(self) -> None:
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        self.process.wait()
        for end in (self.write_end, self.read_end):
            os.close(end)


def gpu_mb() -> int | None:
    words = said("nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits", timeout=5)
    return int(words) if words.isdigit() else None


def probe(where: str, name: str, flags: list[str], port: int) -> dict:
    result = {"way": name, "flags": flags}
    browser = None
    try:
        browser = Browser(where, flags, f"probe-{name}")
        result["browser"] = browser.version
        browser.call("Page.navigate", url=f"http://127.0.0.1:{port}/probe.html")
        for _ in range(50):
            if browser.evaluate("Boolean(window.probe)"):
                break
            time.sleep(0.1)
        result |= browser.evaluate("probe()", 12)
    except Exception as error:
        result["error"] = f"{type(error).__name__}: {error}"[:300]
    if browser:
        result["errors"] = browser.tail()
        browser.close()
    log("try", json.dumps(result, indent=1))
    record["tries"].append(result)
    save()
    return result


def measure(where: str, way: dict, name: str, count: int, port: int) -> None:
    entry = {"viewer": name, "splats": count, "way": way["way"]}
    browser, before = None, gpu_mb()
    try:
        browser = Browser(where, way["flags"], f"{name}-{count}")
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=(folder / "drive.js").read_text())
        browser.call("Page.navigate", url=f"http://127.0.0.1:{port}/" + VIEWERS[name].format(count=count, kind=KIND))
        # Until the document with the script is there, the old one answers.
        for _ in range(100):
            try:
                if browser.evaluate("location.href !== 'about:blank' && Boolean(window.bench)", 30):
                    break
            except RuntimeError:
                pass
            time.sleep(0.05)
        entry |= browser.evaluate(f"bench.open('{name}')", min(20 if name == 'webgpu' else 60, max(10, left() - 5)))
        entry["runs"] = []
        for _ in range(3):
            if left() < 8:
                break
            limit = max(1, min(3, left() / 5))
            entry["runs"].append(browser.evaluate(f"bench.run({WARM}, {FRAMES}, {limit})", 3 * limit + 15))
        if name != "auto" and left() > 8:
            entry["singles"] = browser.evaluate(f"bench.singles(22, {max(1, min(4, left() / 6))})", 30)
        metrics = {m["name"]: m["value"] for m in browser.call("Performance.getMetrics")["metrics"]}
        entry["js_heap_mb"] = round(metrics["JSHeapUsedSize"] / 1e6, 1)
        entry["memory"] = browser.processes()
        after = gpu_mb()
        entry["gpu_mb"] = None if None in (before, after) else after - before
        browser.evaluate("bench.picture().then(() => 1)", 10)
        shot = browser.call("Page.captureScreenshot", 10, format="jpeg", quality=80,
                            clip={"x": 0, "y": 0, "width": WIDTH, "height": HEIGHT, "scale": 640 / WIDTH})  # fmt: skip
        (folder / "tmp" / f"{name}-{count}.jpg").write_bytes(base64.b64decode(shot["data"]))
    except Exception as error:
        entry["error"] = f"{type(error).__name__}: {error}"[:600]
    if rates := sorted(run["fps"] for run in entry.get("runs", [])):
        entry["fps"] = round(rates[len(rates) // 2], 2)
    if browser:
        if "error" in entry:
            entry["errors"], entry["events"] = browser.tail(), browser.events[-8:]
        browser.close()
    log("record", json.dumps(entry))
    record["records"].append(entry)
    save()


def main() -> None:
    out.mkdir(parents=True, exist_ok=True)
    makers = []
    for count in SIZES if KIND == "ply" else ():  # while the browser is unpacked
        makers.append(subprocess.Popen([sys.executable, str(folder / "scene.py"), str(folder / "www" / str(count)), str(count)]))
    unpack("www", folder)
    unpack("chromium", root)
    where = set_up()
    save()
    (folder / "www" / "probe.html").write_text(PROBE)

    class Quiet(http.server.SimpleHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *words):
            pass

        def end_headers(self):
            self.send_header("Cache-Control", "no-store")
            super().end_headers()

    for page in (folder / "www").glob("*/page.html"):
        page.write_text(page.read_text().replace("</script>\n<script id=\"packed\"", OPENED + "</script>\n<script id=\"packed\"", 1))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder / "www")))
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    port = server.server_port

    good = []
    for name, flags in () if os.environ.get("NO_GPU") else BACKENDS.items():
        if left() < BUDGET / 2 or len(good) == 2:
            break
        if len(good) == 1 and name not in ("gl-egl",):
            continue  # the second only to compare
        tried = probe(where, name, flags, port)
        if os.environ.get("GPU", "nvidia") in str(tried.get("renderer")).lower():
            good.append(tried)
    if not good:
        if not ALLOW_SOFTWARE:
            raise SystemExit("no way to the GPU")
        log("NO WAY TO THE GPU: software renderer")
        good.append(probe(where, "software", SOFTWARE, port))
    way = good[0]
    if len(good) == 2 and good[1].get("raf_hz", 0) > 1.25 * good[0].get("raf_hz", 0):
        way = good[1]
    record.update(chosen=way["way"], scenes=KIND, window=[WIDTH, HEIGHT])
    for maker in makers:
        maker.wait(60)
    plan = [(way, name, count) for names in (FIRST, REST) for count in SIZES for name in names]
    if os.environ.get("ONLY"):
        plan = [entry for entry in plan if entry[1] in os.environ["ONLY"].split(",")]
    plan += [(other, name, count) for other in good if other is not way for count in SIZES for name in FIRST]
    for entry in plan:
        if left() < 15:
            log("no time left for", entry[0]["way"], *entry[1:])
            continue
        if entry[1] == "webgpu" and "nvidia" not in str(entry[0].get("webgpu")).lower():
            log("no WebGPU on the GPU")
            continue
        measure(where, *entry, port)
    pictures = glob.glob(f"{folder}/tmp/*.jpg")
    with tarfile.open(out / "pictures.tar", "w") as archive:
        for path in pictures:
            archive.add(path, Path(path).name)
    save()
    for entry in record["records"]:
        single = entry.get("singles", {}).get("median_ms")
        log(entry["way"], entry["viewer"], entry["splats"], "fps", entry.get("fps"), "single ms", single and round(single, 1),
            "open ms", entry.get("open_ms"), "heap MB", entry.get("js_heap_mb"), entry.get("error", ""))
    log("done")


main()
