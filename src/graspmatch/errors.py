"""The one exception that users see."""


class GraspmatchError(Exception):
    """Something the user gave cannot be used; the message says what was wrong and what is possible."""
