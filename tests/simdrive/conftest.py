import pytest
from simdrive_bench import Bench


@pytest.fixture
def bench() -> Bench:
    return Bench()
