"""Who may use a node of /dev, for messages to people."""

import grp
import os
import pwd


def group_of(path: str, otherwise: str) -> str:
    """Name of the group that may use the node; `otherwise` where only root may or nothing is known."""
    try:
        gid = os.stat(path).st_gid
        return grp.getgrgid(gid).gr_name if gid else otherwise
    except (OSError, KeyError):
        return otherwise


def user_name() -> str:
    """Name of the user this process runs as, or its number."""
    uid = os.geteuid()
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)
