"""The two kinds of failure that a user sees; the text of each is one line."""


class InputError(ValueError):
    """Input that cannot be used; the text says what, where, and what to do. Exit code 2."""


class ConfigError(InputError):
    """A configuration that cannot be used."""


class RunFailedError(Exception):
    """Failure of a run. Exit code 1."""
