"""pytest plugin: the fixture `simulated_drive`, a drive on a bus for the tests of a master.

pytest imports this module in every run, wherever canwall is installed: it imports nothing else
before a test asks for a drive.
"""

import contextlib
import logging
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from canwall.library.simulated_drive import SimulatedDrive

_log = logging.getLogger(__name__)

_MARKER = (
    "simulated_drive(eds=None, *, node_id=5, interface='virtual', sync=False, ...): "
    "arguments of canwall.SimulatedDrive for the drive of this test"
)


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    config.addinivalue_line("markers", _MARKER)


@pytest.fixture(scope="session")
def simulated_drive_args() -> dict[str, Any]:
    """Arguments for every simulated drive; override it in a conftest.py."""
    return {}


@pytest.fixture
def make_simulated_drive(
    simulated_drive_args: dict[str, Any],
) -> "Iterator[Callable[..., SimulatedDrive]]":
    """Make simulated drives that are on their bus until the end of the test.

    Its arguments are those of `canwall.SimulatedDrive`, and take precedence over those of
    `simulated_drive_args`.
    """
    with contextlib.ExitStack() as stack:

        def make(*args: Any, **kwargs: Any) -> "SimulatedDrive":
            from canwall.compiled import announce_compiling
            from canwall.library.simulated_drive import SimulatedDrive

            announce_compiling(lambda: _log.warning("compiling for this machine, once"))
            options = simulated_drive_args | kwargs
            if args:  # the dictionary, by its place
                options.pop("eds", None)
            return stack.enter_context(SimulatedDrive(*args, **options))

        yield make


@pytest.fixture
def simulated_drive(
    request: pytest.FixtureRequest, make_simulated_drive: "Callable[..., SimulatedDrive]"
) -> "SimulatedDrive":
    """A simulated CiA 402 drive, on its bus and ready.

    `@pytest.mark.simulated_drive(...)` has its arguments; of several markers the closest counts.
    """
    marker = request.node.get_closest_marker("simulated_drive")
    return make_simulated_drive(*marker.args, **marker.kwargs) if marker else make_simulated_drive()
