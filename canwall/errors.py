"""The two kinds of failure that a user sees; the text of each is one line for him."""


class InputError(ValueError):
    """What was given cannot be used: the text says what, where, and what to do. Exit code 2."""


class ConfigError(InputError):
    """A configuration that cannot be used."""


class RunFailedError(Exception):
    """What was asked for failed while it ran. Exit code 1."""
