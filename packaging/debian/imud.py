#!/usr/lib/imud/bin/python3 -I
import sys

from imud.cli import main

sys.exit(main())
