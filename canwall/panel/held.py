"""Cache of what takes long to read."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")


class Held(Generic[T]):
    """The values that were asked for last, for several threads; each is made once."""

    def __init__(self, most: int) -> None:
        """Hold at most so many values."""
        self._most = most
        self._values: OrderedDict[Hashable, T] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the value of a key, made now if it is not held; one at a time is made."""
        with self._lock:
            if key not in self._values:
                made = make()
                while len(self._values) >= self._most:
                    self._values.popitem(last=False)
                self._values[key] = made
            self._values.move_to_end(key)
            return self._values[key]
