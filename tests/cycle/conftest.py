"""Both exchanges, by the same tests: over python-can's virtual bus, and native on a socket pair."""

import contextlib
from collections.abc import Iterator

import pytest
from rig import Rig, RigFactory


@pytest.fixture(params=["python-can", "native"])
def native(request: pytest.FixtureRequest) -> bool:
    return bool(request.param == "native")


@pytest.fixture
def make_rig(native: bool) -> Iterator[RigFactory]:
    with contextlib.ExitStack() as stack:

        def make(*args: object, **kwargs: object) -> Rig:
            rig = Rig(*args, native=native, **kwargs)  # type: ignore[arg-type]
            stack.callback(rig.close)
            return rig

        yield make
