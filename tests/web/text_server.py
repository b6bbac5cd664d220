"""The labelling page with a hundred pairs of texts, started again whenever it is killed.

python tests/web/text_server.py FOLDER [PORT]

Prints ``<process> <url>`` for each start, and ends when its input does. What takes seconds is
imported once, so that a new start takes milliseconds.
"""

import os
import sys
import threading
from pathlib import Path

from popl_rl.web.clips import Clip
from popl_rl.web.guards import guards
from popl_rl.web.label_app import LabelPages
from popl_rl.web.label_store import LabelStore
from popl_rl.web.pages import Pages
from popl_rl.web.server import listen, run

PAIRS = [(2 * index, 2 * index + 1) for index in range(100)]


def serve(folder: Path, port: int) -> None:
    address = listen("127.0.0.1", port)
    store = LabelStore(
        folder / "answers.sqlite", PAIRS, raters_per_pair=10**6, answers=10**6, attention=15
    )
    pages = Pages({index: Clip(text=f"text {index}") for index in range(200)}, language="en")
    labels = LabelPages(store, pages, pause=20)
    guard = guards(hosts=("127.0.0.1",), key=None, rate=20.0, newcomers=120)
    sys.stdout.write(f"{os.getpid()} {address.url}\n")
    sys.stdout.flush()
    run(labels.app(guard), address)


def main() -> None:
    folder, port = Path(sys.argv[1]), int(sys.argv[2])
    while True:
        child = os.fork()
        if not child:
            # Whoever started this is gone when the input ends.
            threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
            serve(folder, port)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        if not os.WIFSIGNALED(status):
            break


if __name__ == "__main__":
    main()
