"""What the system says of a port, in words for people."""

import errno
import termios
from pathlib import Path

import pytest

from imud.errors import LinkBusy, LinkDenied, LinkError, LinkMissing
from imud.links.uart.port_setup import explain


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.ENOENT, LinkMissing),
        (errno.ENXIO, LinkMissing),
        (errno.ENODEV, LinkMissing),
        (errno.EACCES, LinkDenied),
        (errno.EPERM, LinkDenied),
        (errno.EBUSY, LinkBusy),
        (errno.EAGAIN, LinkBusy),
        (errno.EIO, LinkError),
        (errno.EINVAL, LinkError),
    ],
)
def test_each_number_has_its_error_which_names_the_port(number: int, kind: type[LinkError], tmp_path: Path) -> None:
    for error in (OSError(number, "text"), termios.error(number, "text")):
        explained = explain(error, "/dev/ttyS9", tmp_path)
        assert type(explained) is kind
        assert str(explained).startswith("/dev/ttyS9")


def test_an_unseen_holder_is_another_program(tmp_path: Path) -> None:
    assert "in use by another program" in str(explain(OSError(errno.EBUSY, ""), "/dev/ttyS9", tmp_path))


def test_errors_without_a_number_keep_their_text(tmp_path: Path) -> None:
    assert "no such thing" in str(explain(ValueError("no such thing"), "/dev/ttyS9", tmp_path))
