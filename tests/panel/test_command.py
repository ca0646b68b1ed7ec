"""`canwall panel` as a program: what it is given, what it prints, and the runs beside it."""

import json
import shutil
import signal
import ssl
import subprocess
from pathlib import Path
from typing import Any

import httpx2
import pytest
from commands import Record, Start, command, config_file, wait_for
from fork_server import COMMAND
from test_live import PageOf

from canwall import config


class Address:
    """Where a panel listens, by the line that it prints."""

    def __init__(self, line: str) -> None:
        self.url, _, self.token = line.strip().partition("?token=")
        self.address = self.url.removeprefix("http://").removesuffix("/")
        self.bearer = {"Authorization": f"Bearer {self.token}"}


def begun(panel: "subprocess.Popen[str]") -> Any:
    assert panel.stdout is not None
    assert panel.stderr is not None
    line = panel.stdout.readline()
    assert line, panel.stderr.read()
    return Address(line)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--host", "192.0.2.1"], "give --tls-cert and --tls-key, or leave out --host"),
        (["--host", "0.0.0.0"], "give the one by which the page is opened"),
        (["--host", "no.such.host.invalid"], "no address of this machine"),
        (["--tls-cert", "c.pem"], "give both, or none"),
        (["--tls-cert", "c.pem", "--tls-key", "k.pem"], "cannot be used"),
        (["nothing.toml"], "no such file"),
        (["nothing.nc"], "no such file"),
        (["runs/nothing"], "no such"),
        (["nothing"], "no such"),
        (["--dead-man", "60"], "dead-man"),
        (["--port", "70000"], "port"),
    ],
)
@pytest.mark.slow
def test_bad_input_is_one_line(tmp_path: Path, arguments: list[str], said: str) -> None:
    done = command("panel", "--no-browser", *arguments, cwd=tmp_path)
    (line,) = done.stderr.splitlines()
    assert said in line
    assert done.returncode == 2
    assert not done.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_port_that_is_taken(start: Start, tmp_path: Path) -> None:
    address = begun(start(COMMAND, "panel", tmp_path, "--no-browser"))
    port = address.address.partition(":")[2]
    done = command("panel", tmp_path, "--no-browser", "--port", port)
    assert done.returncode == 2
    assert "in use" in done.stderr


@pytest.mark.slow
def test_ctrl_c_ends_the_panel(start: Start, tmp_path: Path) -> None:
    panel = start(COMMAND, "panel", tmp_path, "--no-browser")
    address = begun(panel)
    answer = httpx2.get(f"{address.url}", params={"token": address.token}, follow_redirects=True)
    assert "<title>" in answer.text
    panel.send_signal(signal.SIGINT)
    _, errors = panel.communicate(timeout=60.0)
    assert panel.returncode == 0
    assert errors.splitlines() == ["canwall: Ctrl-C ends the panel; a run goes on"]


@pytest.mark.slow
def test_other_commands_import_nothing_of_it(tmp_path: Path) -> None:
    import sys

    code = (
        "import sys; from canwall.cli import guarded, app; "
        "guarded(lambda: app(['config'], standalone_mode=False)); "
        "print([m for m in sys.modules if m.split('.')[0] in ('starlette', 'uvicorn', 'uplot')"
        " or m.startswith('canwall.panel')], file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.stderr.strip() == "[]"


#: Changes of config/sim.toml for a run by the clock on a machine that has other things to do.
BUSY = {
    "cycle_s = 0.001": "cycle_s = 0.004",
    "watchdog_s = 0.1": "watchdog_s = 2.0",
    "stuck_rad = 0.0006": "stuck_rad = 0.0",
    "late_cycles = 50": "late_cycles = 0",
    "hold_cycles = 2": "hold_cycles = 100",
    "ramp_cycles = 10": "ramp_cycles = 1000",
}


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_run_outlives_its_panel_and_is_stopped_by_the_next(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    settings = config_file(tmp_path / "bench.toml", BUSY)
    runs = tmp_path / "runs"
    runs.mkdir()
    monkeypatch.chdir(tmp_path)
    panel = start(COMMAND, "panel", settings, "--no-browser")
    first = begun(panel)
    with PageOf.opened(first) as page:
        wrong = page.ask("start", changes={"limits": {"torque_nm": 5.0}})
        assert "lowers limits only" in wrong["error"]
        started = page.ask("start", changes={"law": "damped", "stiffness_nm_per_rad": 2.0})
        assert started["ok"]
        page.event("run", state="attached")
        wall = page.event("settings")["wall"]
        assert (wall["law"], wall["stiffness_nm_per_rad"]) == ("damped", 2.0)
        page.event("contact", law="damped")
        assert page.ask("change", law="midpoint", stiffness_nm_per_rad=3.0)["ok"]
        page.event("settings", revision=1)
        panel.send_signal(number)
        folder = Path(started["folder"])
        assert folder.parent.resolve() == runs
        again = start(COMMAND, "panel", folder, "--no-browser")
        with PageOf.opened(begun(again)) as other_page:
            settings_now = other_page.event("settings")
            assert settings_now["wall"]["law"] == "midpoint"
            other_page.event("contact", law="midpoint")
            stopped = other_page.ask("stop")
            assert stopped["confirmed"]
            assert (
                "stopped by another process, the panel or a script"
                in other_page.event("run", state="ended")["text"]
            )
            again.send_signal(signal.SIGINT)
        panel.kill()
    panel.wait()
    record = Record(folder)
    wait_for((folder / "summary.json").exists)
    assert record.summary["trips"]
    said = [json.loads(line)["what"] for line in (folder / "events.jsonl").read_text().splitlines()]
    assert said == ["change", "stop"]
    # On the bus: after the stop, not one RPDO with a torque.
    torques = [int.from_bytes(sent[2:4], "little", signed=True) for _, sent in record.cycles]
    cycle = int(record.summary["trips"][0].split()[1])
    assert any(torques[: cycle + 1])
    assert not any(torques[cycle + 1 :])


@pytest.mark.slow
def test_run_that_does_not_begin_says_why(start: Start, tmp_path: Path) -> None:
    eds = str(config.shipped("eds/canwall-drive.eds"))
    settings = config_file(tmp_path / "bench.toml", {eds: str(tmp_path / "none.eds")})
    panel = start(COMMAND, "panel", settings, "--no-browser")
    with PageOf.opened(begun(panel)) as page:
        assert page.ask("start")["ok"]
        failed = page.event("run", state="failed")
        assert "none.eds" in failed["text"]
        assert page.ask("mark", text="x")["error"] == "no run is in progress"
        assert page.ask("start", config="sim", duration_s=-1.0)["ok"] is False


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("openssl") is None, reason="makes a certificate with openssl")
def test_tls(start: Start, tmp_path: Path) -> None:
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    kind = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1"]
    files = ["-keyout", tmp_path / "key.pem", "-out", tmp_path / "cert.pem"]
    subprocess.run(["openssl", *kind, *names, *files], check=True, capture_output=True)
    tls = ["--tls-cert", tmp_path / "cert.pem", "--tls-key", tmp_path / "key.pem"]
    panel = start(COMMAND, "panel", tmp_path, "--no-browser", "--host", "localhost", *tls)
    address = begun(panel)
    assert address.url.startswith("https://localhost:")
    trusted = ssl.create_default_context(cafile=str(tmp_path / "cert.pem"))
    with httpx2.Client(verify=trusted) as client:
        answer = client.get(address.url, params={"token": address.token})
        assert "Secure" in answer.headers["set-cookie"]
        page = {"Origin": address.url.removesuffix("/")}
        assert (
            client.post(f"{address.url}api/start", headers=page, json={"a": 1}).status_code == 400
        )
        page = {"Origin": page["Origin"].replace("https", "http")}
        assert client.post(f"{address.url}api/start", headers=page, json={}).status_code == 403
