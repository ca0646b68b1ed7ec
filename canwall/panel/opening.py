"""Opening of a panel on what the command line names."""

import os
from dataclasses import dataclass
from pathlib import Path

from canwall import config
from canwall.config import ConfigError
from canwall.panel.launch import Launcher
from canwall.panel.recorded import routes
from canwall.panel.server import Certificate, PanelServer
from canwall.panel.session import Session
from canwall.record import RunFolder

#: Folder of runs where none is named, as `canwall run` has it.
_RUNS = RunFolder.default_path().parent


@dataclass(frozen=True)
class Panel:
    """A panel that listens."""

    session: Session
    server: PanelServer


def open_panel(
    what: Path | None,
    host: str = "127.0.0.1",
    port: int = 0,
    tls: Certificate | None = None,
    dead_man_s: float = 0.0,
    with_run: bool = False,
) -> Panel:
    """Open a panel.

    Args:
        what: A configuration or its name, the folder of a run or of runs, or a .nc file of a sweep.
        host: Name or address of this machine.
        port: Port; 0: a free one.
        tls: Certificate for TLS.
        dead_man_s: Time after which a run ends whose page in control has vanished; 0: never [s].
        with_run: End once no run is in progress and no page open, for a while.

    Raises:
        InputError: If `what` is none of these, or the address cannot be had.
    """
    shown, runs, given = _meant(what)
    session = Session(shown, Launcher(runs, given), dead_man_s, with_run)
    return Panel(session, PanelServer(session, routes(shown), host, port, tls))


def _meant(what: Path | None) -> tuple[Path, Path, Path | None]:
    """Return what is shown, the folder of new runs, and the configuration that is offered first."""
    if what is None:
        return _RUNS, _RUNS, None
    if what.is_dir():
        folder = RunFolder(what)
        is_run = folder.config.exists() or folder.signals.exists() or folder.live.exists()
        return what, (what.absolute().parent if is_run else what), None
    if what.suffix == ".nc":
        if not what.is_file():
            raise ConfigError(f"{what}: no such file; give the result of a sweep")
        return what, _RUNS, None
    if what.suffix != ".toml" and os.sep in os.fspath(what):
        raise ConfigError(f"{what}: no such folder; give a configuration, or the folder of a run")
    config.load(what)  # says what is wrong with it
    return _RUNS, _RUNS, what
