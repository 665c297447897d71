"""`python -m imud` is the command `imud`."""

import sys

from imud.cli import main

sys.exit(main())
