"""Starting the page: on this machine only, unless another address is asked for by name.

Everything that needs the extra ``web`` is imported when it is called for, so that a missing package is one clear error.
"""

from __future__ import annotations

import contextlib
import importlib.util
import ipaddress
import socket
import threading
import warnings
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from neuralq.apps.web.addresses import is_everywhere
from neuralq.checks import MissingExtra, check_whole

if TYPE_CHECKING:
    from starlette.applications import Starlette

    from neuralq.apps.web.play import Offer

__all__ = ["check_port", "lab_app", "need", "play_app", "serve", "serve_app"]

"""Names of this machine that no page of another site can take on."""


def lab_app(host: str = "127.0.0.1") -> Starlette:
    """The lab's page and its API as an ASGI application.

    Args:
        host: address it will be served on. Requests must name that address or this machine in their Host header, so
            that a foreign site cannot reach the page through a name of its own (DNS rebinding); served on every
            address (``"0.0.0.0"``, ``"::"``) it answers to any address given as a number, and to this machine's name.

    Raises:
        MissingExtra: starlette or plotly is not installed.

    Example:
        >>> [route.path for route in lab_app().routes][:2]
        ['/', '/plotly.min.js']
    """
    need("starlette", "plotly")
    from neuralq.apps.web.app import application

    return application(host, _plotly_script())


def play_app(offer: Offer, host: str = "127.0.0.1") -> Starlette:
    """The page of a game and its API as an ASGI application.

    Args:
        offer: the game, such as `neuralq.apps.web.play_tictactoe.tictactoe` gives.
        host: as `lab_app` takes it.

    Raises:
        MissingExtra: starlette is not installed.

    Example:
        >>> from neuralq.apps.web.play_tictactoe import tictactoe
        >>> [route.path for route in play_app(tictactoe()).routes][:2]
        ['/', '/api/start']
    """
    need("starlette", what="the page to play on")
    from neuralq.apps.web.play import play_application

    return play_application(offer, host)


def serve(host: str = "127.0.0.1", port: int = 8765, *, open_browser: bool = False) -> None:
    """Serve the lab's page until interrupted.

    Args:
        host: address to listen on; anything but this machine's loopback is warned about, for there is no password.
        port: 0 takes a free one.
        open_browser: whether to show the page in the default browser.

    Raises:
        MissingExtra: starlette, uvicorn or plotly is not installed.
        ValueError: a port out of range.
        OSError: the address cannot be had, such as a port that is in use.

    Example:
        >>> serve(port=65536)
        Traceback (most recent call last):
        ValueError: port must be at most 65535, got 65536
    """
    check_port(port)
    need("starlette", "uvicorn", "plotly")
    serve_app(lambda: lab_app(host), host, port, "The lab", open_browser=open_browser)


def serve_app(
    make: Callable[[], Starlette],
    host: str,
    port: int,
    title: str,
    *,
    open_browser: bool = False,
    announce: Callable[[str], None] | None = None,
) -> None:
    """Serve an application until interrupted.

    Args:
        make: makes it, after the address has been warned about.
        host: as `serve` takes it.
        port: 0 takes a free one.
        title: what is served, as the first words of the line that says where it is.
        open_browser: whether to show it in the default browser.
        announce: called with the address instead of printing that line.

    Raises:
        ValueError: a port out of range.
        OSError: the address cannot be had, such as a port that is in use.

    Example:
        >>> serve_app(lambda: lab_app(), "127.0.0.1", -1, "The lab")
        Traceback (most recent call last):
        ValueError: port must be a whole number of at least 0, got -1
    """
    check_port(port)
    import uvicorn
    from threadpoolctl import threadpool_limits

    from neuralq.apps.web.patience import PatientProtocol

    if not _is_loopback(host):
        warnings.warn(
            f"{title[0].lower()}{title[1:]} is served on {host}, so whoever reaches this machine there can use it: "
            "there is no password and no encryption. Use host='127.0.0.1' to keep it to yourself.",
            stacklevel=3,
        )
    app = make()
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen()
        url = _address(host, listener.getsockname()[1])
        if announce is None:
            print(f"{title} is at {url} (Ctrl-C ends it)", flush=True)
        else:
            announce(url)
        if open_browser:  # a moment later, when it answers
            threading.Timer(0.5, webbrowser.open, [url]).start()
        config = uvicorn.Config(
            app, http=PatientProtocol, log_level="warning", access_log=False, server_header=False
        )  # fmt: skip
        with threadpool_limits(limits=1):  # small matrices: more threads only wait for each other
            with contextlib.suppress(KeyboardInterrupt):  # that is how one ends it
                uvicorn.Server(config).run(sockets=[listener])


def check_port(port: int) -> None:
    """``port`` lies in 0..65535.

    Raises:
        ValueError: otherwise.

    Example:
        >>> check_port(0)
    """
    check_whole("port", port, 0)
    if port > 65535:
        raise ValueError(f"port must be at most 65535, got {port}")


def need(*packages: str, what: str = "the lab's page") -> None:
    """The packages of the extra ``web`` are installed.

    Raises:
        MissingExtra: one is not; the message says how to install it.

    Example:
        >>> need("json")
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingExtra(
            f'{what} needs {" and ".join(missing)}, which is not installed; install it with: pip install "neuralq[web]"'
        )


def _plotly_script() -> Path:
    """The script inside the installed package, found without importing it (which takes a second)."""
    spec = importlib.util.find_spec("plotly")
    assert spec is not None and spec.origin is not None
    script = Path(spec.origin).parent / "package_data" / "plotly.min.js"
    if not script.is_file():
        raise MissingExtra(f'{script} is missing; reinstall plotly with: pip install --force-reinstall "neuralq[web]"')
    return script


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _address(host: str, port: int) -> str:
    if is_everywhere(host):
        host = "127.0.0.1"
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"
