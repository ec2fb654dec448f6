"""Access to the viewer: strangers and hostile clients are refused, and an honest client goes on."""

import socket
import time

import msgspec
import numpy as np
import pytest
import viser
import websockets.asyncio.server
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request
from websockets.sync.client import connect

from coloc_graph.cli import main
from coloc_graph.errors import ColocError, InputError
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.run import Stance
from coloc_graph.viewer import Scene, Viewer, server
from coloc_graph.viewer.access import Access, is_loopback
from coloc_graph.viewer.panel import set_value
from coloc_graph.viewer.scene import layer_of
from coloc_graph.viewer.server import open_listener, url_of

PROTOCOL = [f"viser-v{viser.__version__}"]
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, 5.5], "fov": 0.8, "near": 0.01,
    "far": 1000, "image_height": 400, "image_width": 600, "look_at": [0, 0, 0], "up_direction": [0, 0, 1],
}  # fmt: skip


@pytest.fixture(scope="module")
def viewer():
    """A viewer of a scene without poses; tests leave its controls as they find them."""
    with Viewer(Scene(("A", "B"), ()), port=0) as one:
        yield one


def port_of(viewer):
    return viewer.server.get_port()


def status_of(viewer, path, host="127.0.0.1", **headers):
    """Status of a raw request; 101 for a websocket that is opened."""
    lines = [f"GET {path} HTTP/1.1", *([f"Host: {host}"] if host else [])]
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    with socket.create_connection(("127.0.0.1", port_of(viewer)), timeout=10) as raw:
        raw.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        return int(raw.makefile("rb").readline().split()[1])


UPGRADE = {
    "Upgrade": "websocket", "Connection": "Upgrade", "Sec_WebSocket_Version": 13,
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec_WebSocket_Protocol": PROTOCOL[0],
}  # fmt: skip


def opened(viewer, **more):
    """A websocket to the viewer, as its page opens one."""
    address = f"ws://127.0.0.1:{port_of(viewer)}/{viewer.server.token}"
    return connect(address, subprotocols=PROTOCOL, max_size=None, open_timeout=10, **more)


def send(client, message):
    client.send(message if isinstance(message, (str, bytes)) else msgspec.msgpack.encode(message))


def waited(what, seconds=10.0):
    """True if something comes true in time."""
    ends = time.monotonic() + seconds
    while not what() and time.monotonic() < ends:
        time.sleep(0.005)
    return what()


def control(handle, value):
    return {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("evil.example", None),  # a name that resolves to 127.0.0.1
        ("evil.example:8080", "http://evil.example:8080"),
        ("127.0.0.1", "http://evil.example"),
        ("127.0.0.1", "null"),  # a sandboxed frame, or a file
        ("localhost:1", "http://localhost:2"),  # another program's page on this machine
        ("192.0.2.7", None),
        ("evil@127.0.0.1", None),
        ("127.0.0.1.evil.example", None),
        ("", None),
    ],
)
@pytest.mark.parametrize("kind", ["page", "websocket"])
def test_foreign_hosts_and_origins_are_refused_although_they_know_the_token(viewer, host, origin, kind):
    headers = (UPGRADE if kind == "websocket" else {}) | ({"Origin": origin} if origin else {})
    assert status_of(viewer, f"/{viewer.server.token}", host, **headers) == 403


@pytest.mark.parametrize("kind", ["page", "websocket"])
def test_only_the_address_with_the_token_is_answered(viewer, kind):
    headers, token = (UPGRADE if kind == "websocket" else {}), viewer.server.token
    wrong = ["/", "/?token=" + token, "/index.html", "//" + token, "/%2e%2e/" + token, f"/{token[:-1]}", f"/{token}x"]
    assert [status_of(viewer, path, **headers) for path in wrong] == [403] * len(wrong)
    for host in ("127.0.0.1", "localhost", f"localhost:{port_of(viewer)}", "[::1]:9"):  # 9: through a tunnel
        assert status_of(viewer, f"/{token}", host, **headers) == (101 if kind == "websocket" else 200)
        assert status_of(viewer, f"/{token}/", host, Origin=f"http://{host}", **headers) != 403
    assert status_of(viewer, f"/{token}/../../etc/passwd") == status_of(viewer, f"/{token}/%2e%2e/x") == 404


def test_two_hosts_in_a_request_are_refused(viewer):
    assert status_of(viewer, f"/{viewer.server.token}", "127.0.0.1\r\nHost: evil.example") == 403


def test_a_name_of_this_machine_is_accepted_only_where_others_may_connect():
    def permits(host, name):
        headers = websockets.Headers(Host=name)
        return Access(host, "t").refusal(Request("/t", headers)) is None

    own = socket.gethostname()
    assert [permits("0.0.0.0", name) for name in ("192.0.2.7:80", own, "localhost", "evil.example")] == [
        True, True, True, False,
    ]  # fmt: skip
    assert not permits("127.0.0.1", "192.0.2.7") and permits("::1", "[::1]:80") and permits("10.0.0.1", "10.0.0.1")


MALFORMED = [
    b"", b"\xc1", b"\x91" * 60_000, "text", b"\x00" * 60_000, ["not", "a", "message"], {"type": "NoSuchMessage"},
    {"type": "GuiUpdateMessage"}, {"type": "CommandTriggerMessage", "uuid": 5}, {"type": 5},
    CAMERA | {"position": [float("nan"), 0, 0]}, CAMERA | {"wxyz": [1, 0, 0]}, CAMERA | {"image_height": -1},
    CAMERA | {"fov": "wide"}, CAMERA | {"more": 1}, CAMERA | {"far": 1e300},
    {"type": "ScenePointerMessage", "event_type": "click", "ray_origin": None, "ray_direction": None,
     "screen_pos": [], "modifier": None},
    {"type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0, 0, 1], "ray_direction": [0, 0, 0],
     "screen_pos": [[0, 0]], "modifier": None},
    {"type": "TransformControlsUpdateMessage", "name": "/planned/A", "wxyz": [0, 0, 0, 0], "position": [0, 0, 0]},
    {"type": "TransformControlsUpdateMessage", "name": "/planned/A", "wxyz": [1, 0, 0, 0], "position": [0, "x", 0]},
    {"type": "TransformControlsDragStartMessage", "name": 3}, {"type": "TransformControlsDragEndMessage"},
    {"type": "ShareUrlRequest"}, {"type": "RunJavascriptMessage", "source": "alert(1)"},
    {"type": "FileTransferStartUpload", "source_component_uuid": "x", "transfer_uuid": "y", "filename": "z",
     "mime_type": "", "part_count": 1 << 40, "size_bytes": 0},
]  # fmt: skip


def test_malformed_messages_are_dropped_and_honest_clients_go_on(viewer, capfd):
    panel, server = viewer.panel, viewer.server
    handles = (panel.k_sigma, panel.dark, panel.follow, panel.speed)
    before = [handle.value for handle in handles]
    hostile_values = [
        (panel.k_sigma, "much"), (panel.k_sigma, None), (panel.k_sigma, 1e6), (panel.k_sigma, float("nan")),
        (panel.k_sigma, True), (panel.k_sigma, [1]), (panel.dark, "yes"), (panel.dark, 1), (panel.follow, "Z"),
        (panel.follow, 3), (panel.speed, -1),
    ]  # fmt: skip
    with opened(viewer) as hostile:
        for message in (*MALFORMED, *(control(*one) for one in hostile_values)):
            send(hostile, message)
        visible = {"type": "GuiUpdateMessage", "uuid": panel.dark._impl.uuid, "updates": {"value": True, "label": "x"}}
        send(hostile, visible)
        send(hostile, CAMERA)
        assert waited(lambda: len(server.get_clients()) == 1)  # all before it was read
        assert [handle.value for handle in handles] == before

        with opened(viewer) as honest:  # a later client gets all controls, and moves them
            send(honest, CAMERA | {"position": [1, 2, 3]})
            assert waited(lambda: len(server.get_clients()) == 2)
            for value in (12, before[0]):
                send(honest, control(panel.k_sigma, value))
                assert waited(lambda value=value: panel.k_sigma.value == value)
            for value in ("B", before[2]):
                send(honest, control(panel.follow, value))
                assert waited(lambda value=value: panel.follow.value == value)
            assert len(honest.recv(timeout=10)) > 1000
    assert capfd.readouterr().err == ""


def test_a_message_that_is_too_long_ends_its_connection_alone(viewer, capfd):
    with opened(viewer) as honest:
        with pytest.raises(ConnectionClosed), opened(viewer) as hostile:
            send(hostile, b"\x00" * 10_000_000)
            while True:
                hostile.recv(timeout=10)
        send(honest, CAMERA)
        assert waited(lambda: len(viewer.server.get_clients()) == 1)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("way", ["viser serves by itself", "requests are not checked"])
def test_a_viewer_without_its_guard_does_not_start(monkeypatch, way):
    if way == "viser serves by itself":
        monkeypatch.setattr(server, "VISER_SERVER", "viser.infra.moved")
    else:
        monkeypatch.setattr(Access, "refusal", lambda *_: None)
    listener = open_listener(port=0)
    with pytest.raises(ColocError, match="would serve the viewer to anybody"):
        Viewer(Scene(("A",), ()), listener=listener)


def test_other_websocket_servers_start_as_they_are():
    before = websockets.asyncio.server.serve
    with Viewer(Scene(("A",), ()), port=0) as one, Viewer(Scene(("A",), ()), port=0) as other:
        assert websockets.asyncio.server.serve is before
        assert one.server.token != other.server.token and len(one.server.token) > 20
        assert status_of(one, f"/{other.server.token}") == 403


# ports


def test_a_port_that_is_taken_is_named_at_once(tmp_path, capsys):
    with open_listener(port=0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port} of 127.0.0.1 is taken"):
            Viewer(Scene(("A",), ()), port=port)
        for command in (["view"], ["solve", "--view", "--out", str(tmp_path / "out")]):
            assert main([command[0], str(tmp_path / "no.mcap"), *command[1:], "--port", str(port)]) == 2
            err = capsys.readouterr().err
            assert f"port {port} of 127.0.0.1 is taken" in err and err.count("\n") == 1
    with pytest.raises(InputError, match="not an address of this machine"):
        open_listener("192.0.2.1", 8080)  # set aside for documentation, RFC 5737
    with pytest.raises(InputError, match="there is no port 70000"):
        open_listener(port=70_000)
    with pytest.raises(InputError, match="is not an address"):
        open_listener("no such name", 0)


def test_without_a_port_the_next_free_one_is_taken_and_named(monkeypatch, capsys):
    from coloc_graph.cli.view import take_port

    with open_listener(port=0) as taken:
        monkeypatch.setattr(server, "DEFAULT_PORT", taken.getsockname()[1])
        with take_port(None) as listener:
            port = listener.getsockname()[1]
            assert server.DEFAULT_PORT < port < server.DEFAULT_PORT + server.PORTS_TRIED
        assert f"port {server.DEFAULT_PORT} is taken: the viewer uses port {port}" in capsys.readouterr().err
        monkeypatch.setattr(server, "PORTS_TRIED", 1)
        with pytest.raises(InputError, match="are taken"):
            take_port(None)


@pytest.mark.parametrize(("host", "own"), [("127.0.0.1", True), ("localhost", True), ("::1", True), ("0.0.0.0", False)])
def test_only_loopback_is_private(host, own):
    assert is_loopback(host) is own
    assert url_of("0.0.0.0", 80, "t") == "http://127.0.0.1:80/t" and url_of("::1", 80, "t") == "http://[::1]:80/t"


def test_nobody_is_given_a_share_link(viewer):
    assert viewer.server.request_share_url() is None
    assert viewer.server._share_tunnel is None
    assert viewer.url.startswith("http://127.0.0.1:") and viewer.url.endswith(viewer.server.token)


def test_a_closed_viewer_leaves_its_port():
    viewer = Viewer(Scene(("A",), ()), port=0)
    port = port_of(viewer)
    viewer.close()
    viewer.close()
    open_listener(port=port).close()
    assert not viewer._thread.is_alive()


def test_a_camera_follows_a_robot_although_its_browser_answers_late():
    stances = tuple(Stance(n, 10.0 * n, 10.0 * n + 5, ("A",)) for n in range(3))
    n = np.arange(3)
    path = Trajectory("A", 10.0 * n, floor_pose(3.0 * n, 0.0 * n, 0.0 * n), n, np.tile(1e-4 * np.eye(6), (3, 1, 1)))
    scene = Scene(("A",), stances, (layer_of("joint", ("A",), stances, {"A": path}),))
    with Viewer(scene, port=0) as viewer, opened(viewer) as browser:
        send(browser, CAMERA | {"position": [-1, -2, 3], "look_at": [0, 0, 0]})
        assert waited(lambda: len(viewer.server.get_clients()) == 1)
        camera = next(iter(viewer.server.get_clients().values())).camera
        set_value(viewer.panel.follow, "A")
        aside = np.array([-1.0, -2.0, 3.0])

        def looks_at(place):
            return np.allclose(camera.look_at, place) and np.allclose(camera.position, np.add(place, aside))

        # of some time ago; each a message of its own, so that its coming is seen
        for row, late in ((0, (0.1, 0, 0)), (2, (0.2, 0, 0)), (1, (5, 0, 0))):
            assert viewer.wait_idle()
            send(
                browser,
                CAMERA | {"position": [x + y for x, y in zip(late, aside.tolist(), strict=True)], "look_at": [*late]},
            )
            assert waited(lambda late=late: looks_at(late))
            viewer.go(row)
            assert waited(lambda row=row: looks_at((3.0 * row, 0.0, 0.0)))
