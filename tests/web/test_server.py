import importlib.util
import socket
import threading
import time

import httpx
import pytest
import uvicorn
from starlette.responses import PlainTextResponse

from popl_rl.web import extra
from popl_rl.web.server import listen, regularly, run


def test_what_is_missing_is_told_with_the_command_that_installs_it(monkeypatch):
    extra.require_extra()
    found = importlib.util.find_spec
    monkeypatch.setattr(extra, "find_spec", lambda name: None if name == "uvicorn" else found(name))
    with pytest.raises(ValueError, match=r"need uvicorn; .* pip install 'popl_rl\[web\]'"):
        extra.require_extra()


def test_addresses():
    own = listen("127.0.0.1", 0)
    port = own.socket.getsockname()[1]
    assert own.url == f"http://127.0.0.1:{port}/"
    assert not own.is_public
    own.socket.listen()
    taken = rf"cannot listen on 127\.0\.0\.1 port {port} .* choose another page"
    with pytest.raises(OSError, match=taken):
        listen("127.0.0.1", port)
    own.socket.close()
    everywhere = listen("0.0.0.0", 0)
    assert everywhere.is_public
    everywhere.socket.close()
    with pytest.raises(OSError, match="cannot listen on no such name"):
        listen("no such name", 1)


def test_an_application_is_served(monkeypatch):
    address = listen("127.0.0.1", 0)
    servers, made = [], uvicorn.Server

    def make(config):
        servers.append(made(config))
        return servers[0]

    monkeypatch.setattr(uvicorn, "Server", make)
    thread = threading.Thread(target=run, args=(PlainTextResponse("here"), address))
    thread.start()
    while not servers or not servers[0].started:
        time.sleep(0.01)
    response = httpx.get(address.url)
    servers[0].should_exit = True
    thread.join()
    assert response.text == "here"
    assert "server" not in response.headers


def test_work_is_done_regularly_and_at_the_end():
    times = []
    with regularly(lambda: times.append(time.monotonic()), seconds=0.05):
        time.sleep(0.18)
        within = len(times)
    assert 2 <= within <= 4
    assert len(times) == within + 1


def test_who_comes_before_the_server_waits():
    """An address may be told as soon as it is taken, however long the server takes to start."""
    address = listen("127.0.0.1", 0)
    with address.socket, socket.create_connection(address.socket.getsockname(), timeout=5):
        pass
