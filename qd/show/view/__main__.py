"""The viewer as a command."""

import time

from qd.run.cli import run_command
from qd.show.view.arguments import ViewCfg, check_port, show_of


def main(cfg: ViewCfg) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        FileNotFoundError: If there is no archive.
        ValueError: If anything else is not as it must be.
    """
    began = time.perf_counter()
    check_port(cfg.host, cfg.port)
    show = show_of(cfg)
    from qd.show.view.app import App
    from qd.show.view.crossings import Crossings

    crossings = Crossings(show.robot, cache=cfg.cache, published=show.published)
    app = App(show, crossings)
    try:
        took = time.perf_counter() - began
        address = f"http://{cfg.host}:{cfg.port}"
        print(f"{show.found.run}: {len(show.found.archive):,} elites of {show.robot.name}, ready after {took:.1f} s.")
        print(f"Open {address} in a browser; Ctrl-C ends.", flush=True)
        app.run()
    except KeyboardInterrupt:
        print("\nStopped.")
    finally:
        app.close()


if __name__ == "__main__":
    run_command(ViewCfg, main)
