"""Contract: the errors of the lab's host side."""


class LabError(Exception):
    """The lab cannot continue. Its text is one line for the user: the event and the next step."""


class HungGuest(LabError):
    """The guest does not run any more, not even the loop of process 1, which no test can stop. Another boot can
    help."""
