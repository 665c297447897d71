"""Names of the user and of a device node's group, for error messages of links and signals."""

import grp
import os
import pwd
import stat
from typing import Final

GROUP_ACCESS: Final = stat.S_IRGRP | stat.S_IWGRP
"""Bits of a mode with which members of the node's group may open it for reading and writing."""


def group_of(path: str, otherwise: str) -> str:
    """Return the name of the node's group; `otherwise` if that is root or not known."""
    try:
        gid = os.stat(path).st_gid
        return grp.getgrgid(gid).gr_name if gid else otherwise
    except (OSError, KeyError):
        return otherwise


def user_name() -> str:
    """Return the name of the user that this process runs as, or its number."""
    uid = os.geteuid()
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)
