"""Command `panel`: the page in the browser beside the bench."""

import os
import threading
from pathlib import Path
from typing import Annotated

import typer

from canwall.cli.completion import complete_config
from canwall.cli.output import console, say
from canwall.errors import InputError
from canwall.extras import need


def panel(
    what: Annotated[
        Path | None,
        typer.Argument(
            metavar="CONFIG|DIR|FILE.nc",
            help="A configuration to start, a run in progress or recorded, a folder of runs, or a "
            "sweep; without: config/sim.toml, and what is in runs/.",
            autocompletion=complete_config,
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0: a free one.")] = 0,
    host: Annotated[
        str, typer.Option(help="Name of this machine; other than loopback needs TLS.")
    ] = "127.0.0.1",
    tls_cert: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Certificate for TLS (PEM).")
    ] = None,
    tls_key: Annotated[Path | None, typer.Option(metavar="FILE", help="Its key (PEM).")] = None,
    dead_man: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            min=0.1,
            max=5.0,
            help="End the run this long after the page in control has vanished [s].",
        ),
    ] = None,
    with_run: Annotated[
        bool,
        typer.Option("--with-run", help="End half a minute after the run and the last page."),
    ] = False,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address only.")
    ] = False,
) -> int:
    """Show walls in the browser, live and recorded: see, feel and change them.

    A run goes on when the panel ends.
    """
    need("panel")
    if (tls_cert is None) != (tls_key is None):
        raise InputError("--tls-cert and --tls-key: give both, or none")
    from canwall.panel.opening import open_panel
    from canwall.panel.server import Certificate

    tls = None
    if tls_cert is not None and tls_key is not None:
        tls = Certificate(tls_cert, tls_key)
    opened = open_panel(what, host, port, tls, dead_man or 0.0, with_run)

    def announce() -> None:
        console.print(
            f"{opened.server.url}?token={opened.server.access.token}",
            soft_wrap=True,
            highlight=False,
        )
        if not with_run:
            say("Ctrl-C ends the panel; a run goes on")
        if not no_browser and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            _show(f"{opened.server.url}?token={opened.server.access.ticket()}")

    try:
        opened.server.serve(announce)
    except KeyboardInterrupt:
        folder = opened.session.folder_of_run
        if folder is not None:
            say(f"the run goes on: canwall panel {folder} attaches to it again")
    return 0


def _show(url: str) -> None:
    """Open a browser, in a thread: some do not come back before they are closed."""
    import webbrowser

    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
