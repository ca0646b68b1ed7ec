"""The plugin, as other people's tests use it."""

import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from canopen.profiles.p402 import BaseNode402
from canopen.sdo import SdoClient

from canwall.library.simulated_drive import SimulatedDrive

pytest_plugins = ["pytester"]

PATIENCE_S = 60.0
ROOT = Path(__file__).parents[2]
#: What the tests below use is imported before, so that an inner run does not import it anew.
USED = (BaseNode402, SimulatedDrive)


@pytest.fixture
def bench(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # it may be installed, or not
    pytester.makeini("[pytest]\nfilterwarnings = error\naddopts = --strict-markers")
    return pytester


def run(bench: pytest.Pytester) -> pytest.HookRecorder:
    return bench.inline_run("-p", "canwall.library.pytest_plugin")


def test_example_of_the_documentation(
    bench: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A busy machine is no failure of the drive.
    monkeypatch.setattr(SdoClient, "RESPONSE_TIMEOUT", PATIENCE_S)
    for name in ("SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
        monkeypatch.setattr(BaseNode402, f"TIMEOUT_{name}", PATIENCE_S)
    bench.makepyfile((ROOT / "docs" / "test_my_master.py").read_text())
    run(bench).assertoutcome(passed=1)


@pytest.mark.slow
@pytest.mark.parametrize("interface", ["unixcan", "socketcan"])
def test_master_in_a_process_of_its_own(
    bench: pytest.Pytester, interface: str, tmp_path: Path
) -> None:
    channel = str(tmp_path / "bus") if interface == "unixcan" else "vcan0"
    if interface == "socketcan" and not Path("/sys/class/net/vcan0").exists():
        pytest.skip("no vcan0")
    for name in ("foreign_master", "test_foreign_master"):
        bench.makepyfile(**{name: (ROOT / "docs" / f"{name}.py").read_text()})
    bench.makeconftest(
        f"""
        import pytest

        @pytest.fixture(scope="session")
        def simulated_drive_args():
            return {{"interface": {interface!r}, "channel": {channel!r}}}
        """
    )
    run(bench).assertoutcome(passed=1)


def test_marker_has_the_arguments_of_the_drive(bench: pytest.Pytester) -> None:
    bench.makepyfile(
        """
        import pytest

        pytestmark = pytest.mark.simulated_drive(node_id=9)

        def test_of_the_module(simulated_drive):
            assert simulated_drive.node_id == 9

        @pytest.mark.simulated_drive(node_id=7, simulation={"rated_torque_nm": 2.0})
        def test_of_its_own(simulated_drive):
            assert simulated_drive.node_id == 7

        @pytest.mark.simulated_drive(node_id=200)
        def test_wrong(simulated_drive):
            pass
        """
    )
    result = run(bench)
    result.assertoutcome(passed=2, failed=1)
    (failed,) = result.getfailures()
    assert "node_id: has to be less than or equal to 127, not 200" in failed.longreprtext


def test_arguments_for_all_drives(bench: pytest.Pytester) -> None:
    bench.makeconftest(
        """
        import pytest

        @pytest.fixture(scope="session")
        def simulated_drive_args():
            return {"node_id": 11, "real_time": False}
        """
    )
    bench.makepyfile(
        """
        def test_several_on_one_bus(simulated_drive, make_simulated_drive):
            other = make_simulated_drive(node_id=12, channel=simulated_drive.channel)
            assert (simulated_drive.node_id, other.node_id) == (11, 12)
            assert simulated_drive.state == other.state
        """
    )
    run(bench).assertoutcome(passed=1)


def test_entry_point_is_the_plugin() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    ((name, value),) = project["entry-points"]["pytest11"].items()
    plugin = EntryPoint(name, value, "pytest11").load()
    assert hasattr(plugin, "simulated_drive")


@pytest.mark.slow
def test_nothing_is_imported_before_a_test_asks() -> None:
    heavy = {"numpy", "numba", "can", "canopen", "pydantic", "canwall.simdrive"}
    program = (
        "import sys, pytest; before = set(sys.modules); import canwall.library.pytest_plugin; "
        "print(*set(sys.modules) - before)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not heavy & set(done.stdout.split())
    assert len(done.stdout.split()) < 10
