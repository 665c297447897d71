"""Contract: the errors of the lab's host side."""


class LabError(Exception):
    """The lab cannot go on. Its text is the one line the user sees: what happened and what to look at."""


class HungGuest(LabError):
    """The guest runs nothing any more, not even the loop of process 1, which no test can stop: another boot may do."""
