"""Running an application until Ctrl-C, on this machine alone unless told otherwise."""

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from starlette.types import ASGIApp

from popl_rl.web.guards import LOOPBACK

__all__ = ["Address", "listen", "regularly", "run"]


@dataclass(frozen=True)
class Address:
    """Where a server listens.

    Attributes:
        socket: Bound, so that nobody else takes it.
        url: What to open.
        is_public: Whether other machines can reach it.
    """

    socket: socket.socket
    url: str
    is_public: bool

    @property
    def reach(self) -> str:
        """Who can open it, in words."""
        return "anybody who can reach it" if self.is_public else "this machine alone"


def listen(host: str, port: int) -> Address:
    """Take an address: who comes before pages are served waits, and is not refused.

    Args:
        host: Name or number of the address.
        port: 0 for any that is free.

    Raises:
        OSError: If it cannot be had; says which.
    """
    try:
        family, kind, protocol, _, where = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        bound = socket.socket(family, kind, protocol)
        try:
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind(where)
            bound.listen()
        except OSError:
            bound.close()
            raise
    except OSError as error:
        raise OSError(
            f"cannot listen on {host} port {port} ({error.strerror or error}); choose another "
            "page.port, 0 for any that is free"
        ) from error
    shown = socket.gethostname() if host in ("0.0.0.0", "::") else host
    shown = f"[{shown}]" if ":" in shown else shown
    return Address(bound, f"http://{shown}:{bound.getsockname()[1]}/", host not in LOOPBACK)


def run(app: ASGIApp, address: Address) -> None:
    """Serve until Ctrl-C or a termination signal, then finish what is being answered."""
    import uvicorn

    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=5,
        lifespan="off",
    )
    with contextlib.suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[address.socket])


@contextlib.contextmanager
def regularly(work: Callable[[], object], *, seconds: float) -> Iterator[None]:
    """Do something at the start, every so often in a thread of its own, and at the end."""
    over = threading.Event()

    def repeat() -> None:
        while not over.wait(seconds):
            work()

    work()
    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        work()
