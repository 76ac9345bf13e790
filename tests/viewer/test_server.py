# SPDX-License-Identifier: Apache-2.0
"""What the viewer's server lets in, asked with raw sockets as somebody would who means harm."""

import asyncio
import math
import os
import socket
import threading
from unittest.mock import Mock

import msgspec
import pytest
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.viewer.viewer import Viewer
from short_trainings import command_line, set_up, trained
from viser._messages import ResetGuiMessage, ViewerCameraMessage
from websockets.asyncio.client import connect

from nrfgs_ns.errors import InputError
from nrfgs_ns.export.command import Compact
from nrfgs_ns.trained.command import view_file
from nrfgs_ns.trained.loading import load_model
from nrfgs_ns.viewer.server import LocalViewerConfig

pytestmark = pytest.mark.usefixtures("no_cuda")

SECONDS = 300
"""Until an answer counts as one that never comes."""


@pytest.fixture(scope="module")
def interface() -> str:
    """An address of this machine that others reach; no packet is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        unreachable = probe.connect_ex(("192.0.2.1", 9))
        address = probe.getsockname()[0]
    if unreachable or address.startswith("127."):
        pytest.skip("this machine has no network interface")
    return address


@pytest.fixture(scope="module")
def to_all(open_viewer, pipeline) -> Viewer:
    """A viewer that listens on all interfaces, as was asked for."""
    return open_viewer(pipeline, LocalViewerConfig(websocket_host="0.0.0.0"))


def reachable(address: str, port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((address, port)) == 0


def answer(address: str, port: int, path: str, *headers: str, host: str | None = None) -> tuple[int, bytes]:
    """Status and body of the answer to a GET whose path is sent as it is."""
    lines = [f"GET {path} HTTP/1.1", f"Host: {host or f'{address}:{port}'}", *headers, "", ""]
    with socket.create_connection((address, port), timeout=SECONDS) as connection, connection.makefile("rb") as file:
        connection.sendall("\r\n".join(lines).encode())
        received = file.readline()
        if b" 101 " not in received:  # a WebSocket stays open; all others are closed behind the body
            received += file.read()
    head, _, body = received.partition(b"\r\n\r\n")
    return int(head.split()[1]), body


def upgrade(address: str, port: int, *headers: str, host: str | None = None) -> int:
    """Status of the answer to a wish for a WebSocket; 101 is yes."""
    wish = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
    return answer(address, port, "/", *wish, "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", *headers, host=host)[0]


@pytest.mark.parametrize("options", [LocalViewerConfig(), ViewerConfig()], ids=["ours", "nerfstudio's default"])
def test_the_network_is_refused_unless_it_is_asked_for(open_viewer, pipeline, interface, options):
    viewer = open_viewer(pipeline, options)
    port = viewer.viser_server.get_port()
    assert reachable("127.0.0.1", port)
    assert not reachable(interface, port)
    assert "127.0.0.1" in viewer.viewer_info[0] and f"ssh -L {port}:localhost:{port}" in viewer.viewer_info[-1]


@pytest.mark.parametrize("options, says", [
    ({"websocket_port": 65536}, "port is 65536"),
    ({"websocket_host": "192.0.2.1"}, "cannot listen on '192.0.2.1'"),  # of no machine (RFC 5737)
    ({"websocket_host": "." * 70}, "cannot listen on"),
])  # fmt: skip
def test_where_nothing_can_listen_is_told(open_viewer, pipeline, options, says):
    with pytest.raises(InputError, match=says):
        open_viewer(pipeline, LocalViewerConfig(**options))


@pytest.mark.parametrize("path", [
    "/../../../../../../../../../../etc/passwd",
    "/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
    "/../__init__.py", "/assets", "/a\0b", "/" + "a" * 5000, "http://elsewhere/index.html",
])  # fmt: skip
def test_no_file_outside_the_page_is_served(to_all, interface, path):
    status, body = answer(interface, to_all.viser_server.get_port(), path)
    assert status == 404 and body == b"404"


def test_the_network_is_served_if_it_is_asked_for_under_this_machines_names_alone(to_all, interface):
    port = to_all.viser_server.get_port()
    for name in ("localhost:1234", "127.0.0.1", "[::1]:7007", interface, f"{socket.gethostname()}:{port}"):
        assert answer(interface, port, "/", host=name)[0] == 200, name
        assert upgrade(interface, port, host=name) == 101, name
    # A name that somebody's own name server makes point to this machine while the page is open.
    for name in ("evil.example", "evil.example:7007", "localhost.evil.example", "user@evil.example", "[", ""):
        assert answer(interface, port, "/", host=name or " ")[0] == 403, name
        assert upgrade(interface, port, host=name or " ") == 403, name
    assert answer(interface, port, "/", f"Host: {interface}")[0] == 403, "two of them"
    status, body = answer(interface, port, "/")
    assert status == 200 and b"<html" in body.lower()
    assert "Whoever reaches 0.0.0.0" in to_all.viewer_info[-1]


def test_pages_of_other_origins_are_refused(to_all, interface):
    port = to_all.viser_server.get_port()
    assert upgrade(interface, port) == 101, "no browser's page"
    assert upgrade(interface, port, f"Origin: http://{interface}:{port}") == 101
    assert upgrade(interface, port, f"Origin: https://{interface}:{port}") == 101, "behind a proxy"
    others = ["http://evil.example", "https://viewer.nerf.studio", "null", f"http://{interface}"]
    for origin in (*others, f"http://{interface}:{port + 1}", f"http://evil.example://{interface}:{port}"):
        assert upgrade(interface, port, f"Origin: {origin}") == 403, origin
        assert answer(interface, port, "/", f"Origin: {origin}")[0] == 403, origin


CAMERA = {"type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0, 0.0, -3.0]}
CAMERA |= {"fov": 0.9, "aspect": 4 / 3, "look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, -1.0, 0.0]}


def send(port: int, messages: list, until=lambda: True, heard=None) -> None:
    """Be a browser that sends these, packed if dictionaries, until something has come; `heard`: types of what comes."""

    async def talk():
        async with connect(f"ws://127.0.0.1:{port}", max_size=None) as client:

            async def read():
                async for data in client:
                    if heard is not None:
                        heard.update(one["type"] for one in msgspec.msgpack.decode(data))

            reading = asyncio.create_task(read())
            for message in messages:
                await client.send(packed(message))
            while not until():
                await asyncio.sleep(0.01)
            reading.cancel()

    asyncio.run(asyncio.wait_for(talk(), SECONDS))


def update(handle, value) -> dict:
    return {"type": "GuiUpdateMessage", "id": handle._impl.id, "updates": {"value": value}}


def test_sizes_of_pictures_are_held_within_bounds(to_all, pipeline, monkeypatch):
    """A resolution of 20,000 and a window a thousand times as wide as it is high."""
    slider, largest, port = to_all.control_panel._max_res.gui_handle, 2048, to_all.viser_server.get_port()
    drawn = Mock(wraps=pipeline.model.viewer_panel.render)
    monkeypatch.setattr(pipeline.model.viewer_panel, "render", drawn)
    for wish, aspect in ((20_000, 1.0), (20_000, 1e5), (20_000, 1e-5), (-5, 1.0), (0, math.nan)):
        drawn.reset_mock()
        messages, held = [{**CAMERA, "aspect": aspect}, update(slider, wish)], largest if wish > 0 else 64
        send(port, messages, lambda held=held: drawn.call_args_list and slider.value == held)
        assert slider.value == held
        cameras = [call.args[0] for call in drawn.call_args_list]
        assert all(4 <= int(side) <= largest for camera in cameras for side in (camera.width, camera.height))


def packed(message: dict | bytes | str) -> bytes | str:
    return msgspec.msgpack.encode(message) if isinstance(message, dict) else message


UPLOAD = {"source_component_id": "", "transfer_uuid": "a", "filename": "b", "mime_type": "c", "part_count": 10**9}
ODD = [
    b"",
    b"\xc1 not msgpack",
    b"\x93\x01\x02\x03",  # a list
    {"type": "NoSuchMessage"},
    {**CAMERA, "wxyz": [0.0, 0.0, 0.0, 0.0]},
    {**CAMERA, "position": [math.nan, 0.0, 0.0]},
    {**CAMERA, "position": [1e300, 0.0, 0.0]},
    {"type": "ShareUrlRequest"},
    {"type": "FileTransferStart", **UPLOAD, "size_bytes": 10**15},
    {"type": "GuiUpdateMessage", "id": "none", "updates": {"is_button": True}},
    {"type": "GuiUpdateMessage", "id": "none", "updates": [1]},
]


@pytest.mark.parametrize("message", ODD)
def test_a_message_that_no_page_sends_is_dropped(to_all, message):
    server = to_all.viser_server._websock_server
    assert isinstance(server._admit(packed(message)), ResetGuiMessage)
    assert isinstance(server._admit(packed(CAMERA)), ViewerCameraMessage)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_training_survives_odd_messages(tiny_scene, tmp_path):
    """The last is let through, and breaks the viewer of its browser, whose camera the training asks for."""
    messages = [*ODD, "text", {**CAMERA, "wxyz": [1.0, 0.0, 0.0], "position": [0.0, 0.0, 0.0, 0.0]}]
    options = {"--vis": "viewer", "--viewer.quit-on-train-completion": True}
    trainer = set_up(command_line("nrfgs", tiny_scene, tmp_path, 20, options))
    viewer, over, failures = trainer.viewer_state, threading.Event(), []
    camera_of, update_state = viewer.get_camera_state, trainer._update_viewer_state
    browser = threading.Thread(target=send, args=(viewer.viser_server.get_port(), messages, over.is_set), daemon=True)

    def get_camera_state(client):
        try:
            return camera_of(client)
        except Exception:
            failures.append(threading.current_thread())
            raise

    def update_viewer_state(step):
        if step == 3:
            browser.start()
        while step >= 3 and threading.current_thread() not in failures:
            assert browser.is_alive(), "it gave up before the training asked for its camera"
            viewer.last_step = -math.inf  # After one slow picture nerfstudio waits for any number of steps.
            update_state(step)

    viewer.get_camera_state, trainer._update_viewer_state = get_camera_state, update_viewer_state
    try:
        trainer.train()
    finally:
        over.set()
        browser.join(timeout=SECONDS)
        viewer.viser_server.stop()
    assert trainer.step == 19
    assert viewer.viser_server._share_tunnel is None and not viewer.viser_server.gui._current_file_upload_states


def test_a_camera_path_is_saved_in_its_folder_and_a_browser_that_leaves_stops_nobody(to_all):
    """Nerfstudio then raises a KeyError inside `atomic`."""
    with pytest.raises(KeyError), to_all.viser_server.atomic():
        raise KeyError(0)
    assert not to_all.viser_server._websock_server._atomic_lock.locked()
    # Its name is what the browser says, and becomes a file's.
    (name,) = to_all.viser_server._websock_server.file_names
    handle = to_all.viser_server.gui._gui_input_handle_from_id[name]
    send(to_all.viser_server.get_port(), [update(handle, "../../../a\\bc")], lambda: "a_b" in handle.value)
    assert handle.value == ".._.._.._a_bc"


def test_nrfgs_view_opens_a_compact_file_alone(tiny_scene, tmp_path, monkeypatch):
    """Without config.yml and data set it draws what the file's config.yml leads to."""
    config = trained(command_line("nrfgs", tiny_scene, tmp_path / "trained", 2))
    Compact(config, output=tmp_path / "with" / "it.nrf", measure=False).main()
    original = load_model(next((tmp_path / "with").rglob("config.yml")), "test")
    (tmp_path / "alone").mkdir()
    (tmp_path / "with" / "it.nrf").rename(tmp_path / "alone" / "it.nrf")

    viewer = view_file(tmp_path / "alone" / "it.nrf", LocalViewerConfig())
    try:
        model = viewer.pipeline.model
        camera = original.datamanager.eval_dataset.cameras[:1]
        ours, theirs = (one.get_outputs_for_camera(camera)["rgb"] for one in (model, original.model))
        assert (ours - theirs).abs().max() < 1e-6 and ours.std() > 0.01
        drawn = Mock(wraps=model.viewer_panel.render)
        monkeypatch.setattr(model.viewer_panel, "render", drawn)
        # A browser's first view looks away; it is moved to where there is something to see.
        away = {**CAMERA, "position": [0.0, 0.0, 900.0], "look_at": [0.0, 0.0, 1000.0]}
        moves, heard = {"SetCameraPositionMessage", "SetCameraLookAtMessage"}, set()
        send(viewer.viser_server.get_port(), [away], lambda: drawn.called and moves <= heard, heard)
    finally:
        viewer.viser_server.stop()
    assert os.listdir(tmp_path / "alone") == ["it.nrf"], "nothing is written beside it"
