"""The one exception for what a user can fix: bad files, bad scenes, bad settings."""


class InputError(ValueError):
    """Input that cannot be used. The message is one line: what was expected, what was found, what to do."""
