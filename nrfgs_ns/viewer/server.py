# SPDX-License-Identifier: Apache-2.0
"""A guard for nerfstudio's viewer, which viser 0.2.7 serves to all interfaces, with any file that a raw path leads to
(`GET /../../etc/passwd`), to every web page that is open in the user's browser. From `protect` on, viewers listen on
127.0.0.1 unless another host is chosen, and serve viser's page alone, to itself alone. Messages that cannot be read, or
that this page would not send, are dropped, and whatever a message does to the viewer, the training goes on.
"""

import contextlib
import functools
import importlib.metadata
import ipaddress
import re
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from http import HTTPStatus
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import websockets.exceptions
import websockets.server
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.viewer.viewer import Viewer
from nerfstudio.viewer_legacy.server.viewer_state import ViewerLegacyState
from viser import _client_autobuild, _messages, infra
from viser.infra import _infra

from nrfgs_ns.errors import InputError, refusing, require
from nrfgs_ns.host import VISER

LOCAL, ALL_INTERFACES = "127.0.0.1", "0.0.0.0"

WIDEST = 8.0
"""Largest ratio of a picture's sides"""
LENS = (0.01, 3.1)
"""Smallest and largest field of view, radians"""
ALSO_SENT_BY_PAGES = (
    _messages.SceneNodeClickMessage,
    _messages.ScenePointerMessage,
    _messages.TransformControlsUpdateMessage,
)
"""Besides cameras and values of controls. Not among them: uploads, and the request for a public link, which only the
user makes (`--viewer.make-share-url`)."""


@dataclass
class LocalViewerConfig(ViewerConfig):
    """Nerfstudio's viewer, served to this machine alone."""

    websocket_host: str = LOCAL
    """address to listen on. 127.0.0.1: this machine only; from another use ssh -L 7007:localhost:7007 HOST. 0.0.0.0:
    everybody who reaches this machine can look and steer"""


@functools.cache
def protect() -> None:
    """Guard all viewers of this process from now on; InputError if viser is of an unknown version."""
    if (version := importlib.metadata.version("viser")) != VISER:
        raise InputError(f"viser {version}: the viewer is guarded in {VISER} alone. Run: pip install viser=={VISER}.")
    infra.WebsockServer = GuardedServer
    # The page is built. To ask, viser looks through all processes of the machine, and fails if one of them ends then.
    _client_autobuild.ensure_client_is_built = lambda: None
    wrap("__init__", _open_guarded)
    wrap("update_scene", _update_without_exceptions)
    ViewerLegacyState.__init__ = _refused


def wrap(name: str, around: Callable[..., None]) -> None:
    """Let a method of nerfstudio's `Viewer` be `around`, which gets the method itself before its arguments."""
    method = getattr(Viewer, name)
    setattr(Viewer, name, functools.wraps(method)(lambda *args, **options: around(method, *args, **options)))


def _open_guarded(open_viewer: Callable[..., None], viewer: Viewer, config, *args, **options) -> None:
    """Open a viewer on the chosen host, with a line on how to look from elsewhere."""
    if type(config) is ViewerConfig and config.websocket_host == ALL_INTERFACES:  # nobody chose it
        config = replace(config, websocket_host=LOCAL)
    _check_address(config.websocket_host, config.websocket_port)
    open_viewer(viewer, config, *args, **options)
    if viewer.trainer is None:
        viewer.pause_train.visible = False
    server = viewer.viser_server
    tunnel = server._share_tunnel
    if tunnel is not None and tunnel.get_url():
        server._websock_server.names.add(urlsplit(tunnel.get_url()).hostname)
    port = server.get_port()
    wanted = config.websocket_port or config.websocket_port_default
    if port != wanted:
        viewer.viewer_info = [line.replace(f":{wanted}", f":{port}") for line in viewer.viewer_info]
        viewer.viewer_info.append(f"Port {wanted} is busy; the viewer is at {port}.")
    if config.websocket_host in (LOCAL, "localhost"):
        viewer.viewer_info.append(f"From another machine: ssh -L {port}:localhost:{port} {socket.gethostname()}")
    else:
        viewer.viewer_info.append(f"Whoever reaches {config.websocket_host} can look, and steer the training.")


def _update_without_exceptions(update_scene: Callable[..., None], viewer: Viewer, step: int, *args, **options) -> None:
    """Update the scene, as a training does after each step: a browser that leaves, or whose camera is odd, must not end
    it. Also show the number of splats, and the step of a training that is over."""
    with contextlib.suppress(Exception):
        viewer.pipeline.model.viewer_panel.update_count()
        if viewer.trainer is None:
            viewer.update_step(step)
        update_scene(viewer, step, *args, **options)


def _check_address(host: str, port: int | None) -> None:
    """Raise InputError where nothing can listen: viser would wait for ever."""
    require(port is None or 0 < port < 2**16, "The viewer's port", port, f"from 1 to {2**16 - 1}")
    fix = "Give an address of this machine."
    with refusing(f"The viewer cannot listen on {host!r}", fix, OSError, UnicodeError):
        family, kind, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as trial:
            trial.bind(address)


def _refused(*_, **__):
    raise InputError("The legacy viewer is steered by a page of another site. Use --vis viewer.")


class GuardedServer(infra.WebsockServer):
    """Viser's server, with checked requests and messages."""

    def __init__(self, host: str, *args, message_class=infra.Message, **options):
        super().__init__(host, *args, message_class=SimpleNamespace(deserialize=self._admit), **options)
        self._deserialize = message_class.deserialize
        self.names = {"localhost"}
        """host names that this server answers to, lower case"""
        if host not in (LOCAL, "localhost"):
            machine = socket.gethostname().lower()
            self.names |= {host.lower(), machine, f"{machine}.local"}
        self.bounds: dict[str, tuple[float, float]] = {}
        """smallest and largest value of sliders, by id"""
        self.file_names: set[str] = set()
        """ids of text fields that name a file"""

    def queue_message(self, message) -> None:
        """Send a message, and remember the bounds of sliders."""
        if isinstance(message, _messages.GuiAddSliderMessage):
            self.bounds[message.id] = (message.min, message.max)
        elif isinstance(message, _messages.GuiAddTextMessage) and message.label == "Render name":
            self.file_names.add(message.id)
        elif isinstance(message, _messages.ThemeConfigurationMessage):
            message.show_share_button = False
            if message.titlebar_content:
                message.titlebar_content["image"] = None  # of another site, which may be out of reach
        super().queue_message(message)

    @contextlib.contextmanager
    def atomic(self) -> Iterator[None]:
        """Viser's, except that an exception inside, as when a browser leaves, frees the lock."""
        messages = super().atomic()
        messages.__enter__()
        try:
            yield
        finally:
            messages.__exit__(None, None, None)

    def _background_worker(self, ready_sem) -> None:
        # By this name viser serves, here alone, while whoever opens the viewer waits.
        _infra.websockets = SimpleNamespace(server=SimpleNamespace(serve=self._serve), exceptions=websockets.exceptions)
        super()._background_worker(ready_sem)

    def _serve(self, handler, host: str, port: int, process_request, **options):
        """`websockets.server.serve` of requests that are not refused."""

        async def answer(path: str, headers):
            return self._refusal(path, headers) or await process_request(path, headers)

        async def handle(websocket) -> None:
            async def recv() -> bytes:  # viser fails on messages of text
                message = await websocket.recv()
                return message if isinstance(message, bytes) else message.encode()

            await handler(SimpleNamespace(send=websocket.send, recv=recv))

        return websockets.server.serve(handle, host, port, process_request=answer, **options)

    def _refusal(self, path: str, headers) -> tuple[HTTPStatus, dict, bytes] | None:
        """The answer to a request that is not served, None for the others."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._known(hosts[0]):
            return HTTPStatus.FORBIDDEN, {}, b"Not served under this name. Open the viewer by http://localhost:PORT."
        if any(origin.partition("://")[2] != hosts[0] for origin in origins):
            return HTTPStatus.FORBIDDEN, {}, b"Not served to pages of other sites."
        if headers.get_all("Upgrade") == ["websocket"]:
            return None
        root = self._http_server_root.resolve()
        with contextlib.suppress(OSError, ValueError):  # too long, or not a path
            path = path.partition("?")[0]
            file = (root / path.removeprefix("/")).resolve()
            if path == "/" or (file.is_relative_to(root) and file.is_file()):
                return None
        return HTTPStatus.NOT_FOUND, {}, b"404"

    def _known(self, host: str) -> bool:
        """Whether a Host header names this server. Every address does: no name server can redirect one."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
            return name in self.names or bool(ipaddress.ip_address(name))
        except ValueError:
            return False

    def _admit(self, raw: bytes):
        """The message in some bytes, with what decides the size of a picture clamped; one without listeners for what no
        page sends. An exception would leave the client's render thread running for ever."""
        try:
            message = self._deserialize(raw)
            if isinstance(message, _messages.ViewerCameraMessage):
                pose = np.array([*message.wxyz, *message.position], np.float32)
                if len(pose) != 7 or not np.isfinite(pose).all() or not pose[:4].any():
                    raise ValueError("no pose, on which a GPU's kernels may fail")
                message.aspect = _clamped(message.aspect, 1 / WIDEST, WIDEST)
                message.fov = _clamped(message.fov, *LENS)
            elif isinstance(message, _messages.GuiUpdateMessage):
                value = message.updates["value"]
                if message.id in self.file_names:
                    value = re.sub(r"[/\\]", "_", value)
                elif message.id in self.bounds:
                    value = _clamped(value, *self.bounds[message.id])
                message.updates = {"value": value}
            elif not isinstance(message, ALSO_SENT_BY_PAGES):
                raise ValueError(type(message).__name__)
            return message
        except Exception:  # whatever bytes may do to viser
            return _messages.ResetGuiMessage()


def _clamped(value: float, low: float, high: float) -> float:
    """A number between its bounds; NaN becomes `low`."""
    return min(max(low, value), high)
