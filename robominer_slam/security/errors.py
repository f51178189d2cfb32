"""What goes wrong with keys by a user's mistake."""


class KeysError(Exception):
    """Keys that cannot be made or used; the message is one line: what, where, what to do."""
