"""The one error of the lab's host side."""


class LabError(Exception):
    """The lab cannot go on. Its text is the one line the user sees: what happened and what to look at."""
